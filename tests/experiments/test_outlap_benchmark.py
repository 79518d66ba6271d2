"""The out-lap benchmark: its units, the table of several methods, lives from elsewhere, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.lives import PROTOCOL, Yardstick
from outlap.experiments.outlap_benchmark import (
    COLUMNS,
    LIVES,
    LivesUnit,
    foreign_lives,
    lives_units,
    write_benchmark,
)
from outlap.planning.min_laps import MinLaps
from outlap.track.map_io import write_track
from outlap.training.ppo import PPOConfig
from outlap.training.session import train
from synthetic_tracks import ring

TASK = RaceConfig(
    model="nonlinear_single_track", beams=16, control_interval=5, speed_range=(0.0, 3.0),
    observation=("scan", "vel", "frenet"), scale_observations=True, termination={"time_limit": 8.0},  # type: ignore[arg-type]
)  # fmt: skip


@pytest.fixture
def tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two circuits by name, and a yardstick that needs no planning."""
    for name, radius in (("small", 5.0), ("large", 6.0)):
        write_track(ring(radius), tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        Yardstick,
        "of",
        classmethod(lambda cls, track, task, cars: Yardstick(np.full(cars.size, 6.0), MinLaps((), 0.0))),
    )


def trained(folder: str, seed: int, track: str = "small", **changes: object) -> str:
    env = TASK.model_copy(update={"tracks": (track,), **changes})
    config = PPOConfig(env=env, total_steps=128, num_envs=8, n_steps=8, batch_size=64, n_epochs=1, net_arch=(8,))
    train(config.model_copy(update={"seed": seed}), Path(folder))
    return folder


def done(units: list[LivesUnit], folder: Path) -> None:
    for unit in units:
        place = unit.folder(folder / "work")
        place.mkdir(parents=True)
        unit.do(folder / "work", lambda share: None)


def test_runs_of_one_method_are_trainings_of_it(tracks: None, tmp_path: Path) -> None:
    runs = [trained("blind_0", 0), trained("blind_1", 1)]
    knows = ("scan", "vel", "frenet", "vehicle")
    oracle = trained("oracle_0", 0, observation=knows)
    units = lives_units([*runs, oracle, "centerline-follower"], TASK, ["large"], "outside:3", "life", 0)
    assert [(unit.method, unit.training_seed) for unit in units] == [
        ("blind", 0), ("blind", 1), ("oracle", 0), ("centerline-follower", 0)
    ]  # fmt: skip
    assert len({unit.key for unit in units}) == 4
    folder = tmp_path / "benchmark"
    done(units, folder)
    data = write_benchmark(units, folder, "blind", "oracle", 0)
    assert (data["protocol"], data["split"], data["cars"]) == (PROTOCOL, "outside", 3)
    assert {name: each["trainings"] for name, each in data["methods"].items()} == {
        "blind": 2, "oracle": 1, "centerline-follower": 1
    }  # fmt: skip
    lives: Any = pd.read_parquet(folder / LIVES)
    assert tuple(lives.columns) == COLUMNS
    assert len(lives) == 4 * 3 * 3
    assert set(lives["split"]) == {"outside"}
    # The follower knows the track: it gets round. Policies that have learnt nothing do not.
    assert data["methods"]["centerline-follower"]["survival"]["lap_1"]["value"] == 1.0
    assert data["methods"]["blind"]["survival"]["lap_3"]["value"] == 0.0
    # The lives of somebody else's method join the table.
    other: Any = lives[lives["method"] == "centerline-follower"].assign(method="theirs")[list(COLUMNS[:10])]
    other.to_parquet(tmp_path / "theirs.parquet")
    again = write_benchmark(units, folder, "blind", "oracle", 0, [tmp_path / "theirs.parquet"])
    assert (
        again["methods"]["theirs"]["distance_m"]["value"]
        == data["methods"]["centerline-follower"]["distance_m"]["value"]
    )
    other[other["car"] < 2].to_parquet(tmp_path / "fewer.parquet")
    with pytest.raises(OutlapError, match="theirs, training 0: has other cars, tracks or laps than blind"):
        write_benchmark(units, folder, "blind", "oracle", 0, [tmp_path / "fewer.parquet"])


def test_a_unit_is_repeated_only_for_another_policy_car_or_protocol(tracks: None) -> None:
    run = trained("run_0", 0)
    key = lives_units([run], TASK, ["large"], "outside:3", "life", 0)[0].key
    assert lives_units([str(Path(run).resolve())], TASK, ["large"], "outside:3", "life", 0)[0].key == key
    for split, protocol, seed in (("hard:3", "life", 0), ("outside:3", "practice", 0), ("outside:3", "life", 1)):
        assert lives_units([run], TASK, ["large"], split, protocol, seed)[0].key != key  # type: ignore[arg-type]


def test_what_no_benchmark_can_be_made_of_is_refused(tracks: None, tmp_path: Path) -> None:
    run = trained("run_0", 0)
    with pytest.raises(OutlapError, match="run_0: was trained on small"):
        lives_units([run], TASK, ["small"], "outside:3", "life", 0)
    with pytest.raises(OutlapError, match="another run of run has the seed 0"):
        lives_units([run, run], TASK, ["large"], "outside:3", "life", 0)
    (tmp_path / "broken.parquet").write_text("no")
    with pytest.raises(OutlapError, match=r"broken.parquet: cannot be read"):
        foreign_lives(tmp_path / "broken.parquet", "outside")
    pd.DataFrame({"method": ["a"]}).to_parquet(tmp_path / "thin.parquet")
    with pytest.raises(OutlapError, match=r"thin.parquet: has no column training_seed"):
        foreign_lives(tmp_path / "thin.parquet", "outside")
    whole = pd.DataFrame({name: ["hard"] for name in COLUMNS[:10]})
    whole.to_parquet(tmp_path / "other.parquet")
    with pytest.raises(OutlapError, match="is of the split hard; must be outside"):
        foreign_lives(tmp_path / "other.parquet", "outside")
