"""Sweeps: what is drawn, what trials are made of, and how they are judged."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError

from outlap.cli.main import main
from outlap.config import load_config
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.sweep import SweepConfig, judge, plan_trials
from outlap.training.ppo import PPOConfig

TINY = {
    "total_steps": 256, "num_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 1, "net_arch": [8],
    "env": {"tracks": ["Nightjar"], "beams": 8, "termination": {"time_limit": 2.0}},
}  # fmt: skip


def sweep(**changes) -> SweepConfig:
    content = {"algorithm": "ppo", "training": TINY, "search": {"gamma": [0.9, 0.99]}, **changes}
    return SweepConfig.model_validate(content)


def test_every_combination_of_lists_is_tried():
    config = sweep(search={"gamma": [0.9, 0.99], "env.reward.collision_max": [1.0, 5.0, 9.0]})
    drawn = config.draw()
    assert [tuple(values.values()) for values in drawn] == [
        (gamma, penalty) for gamma in (0.9, 0.99) for penalty in (1.0, 5.0, 9.0)
    ]
    trained = config.trial_config(drawn[1])
    assert (trained.gamma, trained.env.reward.collision_max, trained.total_steps) == (0.9, 5.0, 256)


def test_draws_follow_their_distributions_and_the_seed():
    search = {
        "learning_rate": {"log_uniform": [1e-5, 1e-1]}, "gamma": {"uniform": [0.9, 1.0]},
        "n_epochs": {"integer": [1, 3]}, "batch_size": [32, 64],
    }  # fmt: skip
    config = sweep(search=search, trials=2000)
    drawn = pd.DataFrame(config.draw())
    # Uniform over four decades: as many below as above the middle, 1e-3.
    rates = drawn["learning_rate"].to_numpy()
    assert (rates < 1e-3).mean() == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(2000))
    assert rates.min() >= 1e-5
    assert rates.max() <= 1e-1
    assert drawn["gamma"].to_numpy().mean() == pytest.approx(0.95, abs=4 * 0.1 / math.sqrt(12 * 2000))
    assert sorted(set(drawn["n_epochs"])) == [1, 2, 3]
    assert sorted(set(drawn["batch_size"])) == [32, 64]
    pd.testing.assert_frame_equal(drawn, pd.DataFrame(config.draw()))
    assert not drawn.equals(pd.DataFrame(config.model_copy(update={"seed": 1}).draw()))


def test_trials_are_judged_by_the_progress_of_their_races(tmp_path: Path):
    trials = plan_trials(sweep(seeds=2, episodes=3, tracks=["Nightjar", "Foxglove"]))
    assert [[race.training.config.seed for race in trial.races] for trial in trials] == [[0, 1]] * 2  # type: ignore[union-attr]
    assert {(task.track, race.episodes) for trial in trials for race in trial.races for task in race.tasks} == {
        ("Nightjar", 2), ("Foxglove", 2),
    }  # fmt: skip
    progress = {(0, 0): [10.0, 20.0], (0, 1): [30.0, 20.0], (1, 0): [40.0, 40.0], (1, 1): [0.0, 80.0]}
    for trial in trials:
        for race in trial.races:
            metres = progress[trial.number, race.seed]
            rows = pd.DataFrame({"progress_m": metres, "outcome": ["crash", "timeout"], "mean_speed_mps": [1.0, 3.0]})
            write_rows(rows, race.folder(tmp_path) / ROWS)
    found = judge(trials, tmp_path)
    assert found["trial"].tolist() == [1, 0]
    best = found.iloc[0]
    assert (best["gamma"], best["progress_m"], best["progress_low_m"], best["progress_high_m"]) == (0.99, 40, 40, 40)
    assert (best["crash_rate"], best["mean_speed_mps"]) == (0.5, 2.0)
    assert found["progress_low_m"].tolist() == [40.0, 15.0]


def test_a_changed_file_keeps_the_units_of_the_trials_that_it_still_has():
    def keys(**search) -> set[str]:
        races = [race for trial in plan_trials(sweep(search=search, seeds=2)) for race in trial.races]
        return {unit.key for race in races for unit in (race, *race.needs)}

    before = keys(gamma=[0.9, 0.99], n_epochs=[1, 2])
    after = keys(gamma=[0.9, 0.99], n_epochs=[1, 2, 3])  # the numbers of all trials but the first two change
    assert len(before) == 4 * 2 * 2
    assert len(after) == 6 * 2 * 2
    assert before < after


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"search": {}}, "at least 1"),
        ({"search": {"gamma": []}}, "gamma has no values"),
        ({"search": {"gamma": 0.9}}, "gamma must be a list of values, or one of {uniform"),
        ({"search": {"gamma": {"normal": [0, 1]}}}, "gamma must be a list of values, or one of {uniform"),
        ({"search": {"gamma": {"uniform": [1, 0]}}}, "gamma: uniform must have low < high"),
        ({"search": {"gamma": {"uniform": 3}}}, "gamma: uniform must have two numbers"),
        ({"search": {"gamma": {"log_uniform": [0, 1]}}}, "gamma: log_uniform must have low < high, both > 0"),
    ],
)
def test_a_file_that_is_wrong_is_said(changes: dict, message: str):
    with pytest.raises(ValidationError) as error:
        sweep(**changes)
    assert message in str(error.value)


def test_trials_that_cannot_be_are_said_before_the_first_begins():
    with pytest.raises(OutlapError, match=r"trial with gamma 1.5: gamma is 1.5; must be <= 1"):
        plan_trials(sweep(search={"gamma": [0.9, 1.5]}))
    with pytest.raises(OutlapError, match="gama is not a known field; did you mean gamma"):
        plan_trials(sweep(search={"gama": [0.9]}))
    with pytest.raises(OutlapError, match=r"search.gamma is a range, of which trials are drawn; say how many"):
        plan_trials(sweep(search={"gamma": {"uniform": [0.9, 0.99]}}))
    with pytest.raises(OutlapError, match="algorithm is 'dqn'; must be one of ppo"):
        plan_trials(sweep(algorithm="dqn"))


def test_a_sweep_trains_races_and_names_the_best(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    import yaml

    file = tmp_path / "mine.yaml"
    content = {"algorithm": "ppo", "training": TINY, "search": {"gamma": [0.9, 0.99]}, "episodes": 2, "time_limit": 1}
    file.write_text(yaml.safe_dump(content))
    out = tmp_path / "out"
    assert main(["sweep", str(file), "--out", str(out), "--quiet"]) == 0
    found = pd.read_parquet(out / "trials.parquet")
    assert sorted(found["gamma"]) == [0.9, 0.99]
    assert np.isfinite(found["progress_m"]).all()
    assert load_config(PPOConfig, out / "best.yaml").gamma == found["gamma"].iloc[0]
    assert f"outlap train ppo --config {out / 'best.yaml'}" in capsys.readouterr().out
    done = {path: path.stat().st_mtime_ns for path in (out / "work").rglob("done.json")}
    assert len(done) == 4
    # Values that are drawn twice, or that another file has had before, are not trained again.
    file.write_text(yaml.safe_dump({**content, "search": {"gamma": [0.99, 0.99, 0.9]}}))
    assert main(["sweep", str(file), "--out", str(out), "--quiet"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "work").rglob("done.json")} == done
    again = pd.read_parquet(out / "trials.parquet").set_index("trial")
    assert again["gamma"].to_dict() == {0: 0.99, 1: 0.99, 2: 0.9}
    assert again["progress_m"].tolist()[0] == again["progress_m"].tolist()[1]
