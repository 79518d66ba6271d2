"""Training a population: what it leaves, that it goes on where it was, and who enters the manifest."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import PPO

from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import MANIFEST, Member, file_hashes, load_population, read_manifest
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.engine import LocalEngine
from outlap.experiments.opponent_units import OpponentUnit, enter_all
from outlap.experiments.runner import run_units
from outlap.simulator.vehicle import VehicleParams
from outlap.track.map_io import write_track
from outlap.training.opponents import SLOWEST, Opponent, enter, opponent_config, verify
from outlap.training.ppo import PPOConfig
from outlap.training.run import load_run
from small_populations import driver, ring_driver
from stopped_training import stopped_after
from synthetic_tracks import ring

TINY = PPOConfig(
    env=RaceConfig(
        beams=8, control_interval=5, observation=("scan", "vel"), scale_observations=True,
        termination={"time_limit": 8.0},  # type: ignore[arg-type]
    ),
    total_steps=512, num_envs=4, n_steps=8, batch_size=32, n_epochs=1, net_arch=(8,), checkpoint_every=128,
)  # fmt: skip
OPPONENTS = Opponent("ring-2.0", 2.0, "train"), Opponent("ring-3.0", 3.0, "held_out")


class Trained(NamedTuple):
    units: tuple[OpponentUnit, ...]
    work: Path
    folder: Path  # of the population
    found: list[tuple[OpponentUnit, pd.DataFrame, Member | None]]  # who was entered


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A population, the training of whose first member was stopped halfway and gone on with."""
    folder = tmp_path_factory.mktemp("population")
    track = ring(radius=5.0)
    map_folder = str(write_track(track, folder / "maps" / track.name))
    units = tuple(
        OpponentUnit(each.name, TINY, map_folder, each.max_speed_mps, each.split, laps=1, starts=2)
        for each in OPPONENTS
    )
    work = folder / "mine" / "work"
    stopped_after(256, opponent_config(TINY, map_folder, 2.0), units[0].run_folder(work))
    run_units(units, work, LocalEngine(2))
    return Trained(units, work, folder / "mine", enter_all(units, work, folder / "mine", "outlap made this"))


def test_every_opponent_is_trained_and_verified(trained: Trained) -> None:
    assert [unit.opponent for unit, _, _ in trained.found] == list(OPPONENTS)
    for unit, rows, member in trained.found:
        assert rows["driver"].tolist() == [unit.name] * 2
        assert rows["track"].tolist() == ["ring5"] * 2
        assert (member is not None) == (rows["completed_laps"].to_numpy() >= 1).all()
        run = load_run(unit.run_folder(trained.work))
        assert run.finished
        assert run.record()["steps"] == 512
        env = run.config.env
        assert (env.num_cars, env.vehicle.v_max, env.speed_range) == (1, unit.max_speed_mps, (0.5, env.vehicle.v_max))
    passed = {unit.name for unit, _, member in trained.found if member}
    assert {member.name for member in read_manifest(trained.folder, may_be_empty=True)} == passed


@pytest.mark.parametrize("number", [0, 1])
def test_its_files_drive_as_its_policy_does(trained: Trained, number: int) -> None:
    unit = trained.units[number]
    ours = MLPDriver.load(trained.folder / unit.name)
    assert (ours.name, ours.speeds, ours.beams) == (unit.name, (SLOWEST, unit.max_speed_mps), 8)
    model = PPO.load(unit.run_folder(trained.work) / "policy.zip", device="cpu")
    rng = np.random.default_rng(0)
    seen = {name: rng.normal(size=(20, size)).astype(np.float32) for name, size in ours.sizes.items()}
    np.testing.assert_allclose(ours.act(seen), model.predict(seen, deterministic=True)[0], atol=1e-5)


def test_a_stopped_training_goes_on_and_no_other_one_is_resumed(trained: Trained) -> None:
    sessions = [len(load_run(unit.run_folder(trained.work)).record().get("resumed", [])) for unit in trained.units]
    assert sessions == [1, 0]


def test_entered_again_a_population_is_whole_again(trained: Trained) -> None:
    files = {unit.name: file_hashes(trained.folder, unit.name) for unit in trained.units}
    manifest = (trained.folder / MANIFEST).read_bytes()
    (trained.folder / "ring-2.0.safetensors").unlink()
    enter_all(trained.units, trained.work, trained.folder, "outlap made this")
    assert {unit.name: file_hashes(trained.folder, unit.name) for unit in trained.units} == files
    assert (trained.folder / MANIFEST).read_bytes() == manifest


def test_only_those_that_passed_are_in_the_manifest(trained: Trained, tmp_path: Path) -> None:
    work = Path(shutil.copytree(trained.work, tmp_path / "work"))
    for unit, last in zip(trained.units, (0, 1), strict=True):  # completed laps of the second start
        write_rows(verification(1, last).assign(track="ring5"), unit.folder(work) / ROWS)
    found = enter_all(trained.units, work, tmp_path / "population", "outlap made this")
    assert [member is not None for _, _, member in found] == [False, True]
    (member,) = read_manifest(tmp_path / "population")
    assert (member.name, member.split, member.track, member.command) == (
        "ring-3.0", "held_out", "ring5", "outlap made this",
    )  # fmt: skip
    assert (tmp_path / "population" / "ring-2.0.safetensors").is_file()


def test_verification_is_at_the_opponents_own_speeds_until_its_laps_are_done() -> None:
    env = TINY.env.model_copy(update={"vehicle": VehicleParams(v_max=8.0), "speed_range": (3.0, 8.0), "num_cars": 3})
    rows = verify(ring_driver(5.0, "round", speeds=(1.0, 3.0)), env, ring(radius=5.0), laps=2, starts=3)
    assert rows["driver"].tolist() == ["round"] * 3
    assert rows["outcome"].tolist() == ["finished"] * 3
    assert rows["completed_laps"].tolist() == [2] * 3
    np.testing.assert_allclose(rows["lap_time_s"], 2.0 * np.pi * 5.0 / 2.0, rtol=0.05)
    assert len(np.unique(rows["start_m"])) == 3


def test_verification_shows_an_opponent_as_many_beams_as_it_was_trained_on() -> None:
    rows = verify(driver(beams=12), TINY.env, ring(radius=5.0), laps=1, starts=2)
    assert len(rows) == 2


def verification(*laps: int, lap_time: float = 10.0) -> pd.DataFrame:
    """Rows of runs that completed so many laps of three, and crashed where they are fewer."""
    return pd.DataFrame(
        {
            "completed_laps": laps,
            "lap_time_s": [lap_time + number if done else np.nan for number, done in enumerate(laps)],
            "outcome": ["finished" if done >= 3 else "crash" for done in laps],
        }
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With the files of three opponents and no manifest."""
    for seed, name in enumerate("abc"):
        driver(seed, name).save(tmp_path / name)
    return tmp_path


def put(folder: Path, name: str, rows: pd.DataFrame, speed: float = 2.0) -> Member | None:
    return enter(folder, Opponent(name, speed, "train"), rows, "ring5", 3, "outlap opponents train")


def test_an_opponent_that_completed_its_laps_is_entered(folder: Path) -> None:
    member = put(folder, "a", verification(3, 4, 3))
    assert member is not None
    assert read_manifest(folder) == (member,)
    assert (member.name, member.max_speed_mps, member.split, member.track) == ("a", 2.0, "train", "ring5")
    assert (member.verified_laps, member.crash_rate, member.lap_time_s) == (3, 0.0, 11.0)
    assert member.command == "outlap opponents train"
    assert [each.name for each in load_population(folder)] == ["a"]


def test_one_failed_start_keeps_an_opponent_out(folder: Path) -> None:
    assert put(folder, "a", verification(3, 2, 3)) is None
    assert json.loads((folder / MANIFEST).read_text()) == {"opponents": []}
    assert put(folder, "b", verification(0, 0, 0)) is None
    assert read_manifest(folder, may_be_empty=True) == ()


def test_an_opponent_is_entered_again_in_place_of_itself_and_taken_out_once_it_fails(folder: Path) -> None:
    for name, speed in (("c", 4.0), ("a", 3.0), ("b", 2.0)):
        put(folder, name, verification(3, 3), speed)
    others = [member for member in read_manifest(folder) if member.name != "a"]
    assert [member.name for member in read_manifest(folder)] == ["b", "a", "c"]  # by their speeds

    driver(9, "a").save(folder / "a")
    put(folder, "a", verification(5, 5, lap_time=20.0), 3.0)
    (again,) = (member for member in read_manifest(folder) if member.name == "a")
    assert (again.verified_laps, again.lap_time_s) == (5, 20.5)
    assert again.sha256 == file_hashes(folder, "a")
    assert len(load_population(folder)) == 3

    assert put(folder, "a", verification(3, 1), 3.0) is None
    assert list(read_manifest(folder)) == others
    assert (folder / "a.safetensors").is_file()
