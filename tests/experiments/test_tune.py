"""Searches for hyper-parameters: what is drawn, what trials are made of, which are stopped, and how they are judged."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError

pytest.importorskip("optuna", reason="needs Optuna: pip install 'outlap[tune]'")

from one_process import OneProcess
from outlap.cli.main import main
from outlap.config import load_config
from outlap.errors import OutlapError
from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments.engine import LocalEngine
from outlap.experiments.paper_units import RaceUnit
from outlap.experiments.runner import run_units
from outlap.experiments.search import SearchConfig
from outlap.experiments.tune import RungUnit, Tuner
from outlap.experiments.unit import Report, Unit
from outlap.training.checkpoints import TrainingDiverged
from outlap.training.ppo import PPOConfig
from outlap.training.run import load_run
from outlap.training.session import train

TINY = {
    "total_steps": 256, "num_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 1, "net_arch": [8],
    "env": {"tracks": ["Nightjar"], "beams": 8, "termination": {"time_limit": 2.0}},
}  # fmt: skip


def search(**changes) -> SearchConfig:
    content = {"algorithm": "ppo", "training": TINY, "search": {"gamma": [0.9, 0.99]}, **changes}
    return SearchConfig.model_validate(content)


def drawn(folder: Path, **changes) -> list[dict]:
    return [dict(trial.values) for trial in started(folder, **changes).trials]


def started(folder: Path, **changes) -> Tuner:
    tuner = Tuner(search(**changes), folder)
    tuner.first_units()
    return tuner


def test_every_combination_of_lists_is_tried(tmp_path: Path):
    varied = {"gamma": [0.9, 0.99], "env.reward.collision_max": [1.0, 5.0, 9.0], "net_arch": [[8]]}
    tuner = started(tmp_path, search=varied)
    assert [tuple(trial.values.values())[:2] for trial in tuner.trials] == [
        (gamma, penalty) for gamma in (0.9, 0.99) for penalty in (1.0, 5.0, 9.0)
    ]
    trained = tuner.trials[1].rungs[0][0].config
    assert (trained.gamma, trained.env.reward.collision_max, trained.total_steps) == (0.9, 5.0, 256)


def test_draws_follow_their_distributions_and_the_seed(tmp_path: Path):
    varied = {
        "learning_rate": {"log_uniform": [1e-5, 1e-1]}, "gamma": {"uniform": [0.9, 1.0]},
        "n_epochs": {"integer": [1, 3]}, "batch_size": [32, 64],
    }  # fmt: skip
    found = pd.DataFrame(drawn(tmp_path / "a", search=varied, trials=100))
    # Uniform over four decades: as many below as above the middle, 1e-3.
    rates = found["learning_rate"].to_numpy()
    assert (rates < 1e-3).mean() == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(100))
    assert rates.min() >= 1e-5
    assert rates.max() <= 1e-1
    assert found["gamma"].to_numpy().mean() == pytest.approx(0.95, abs=4 * 0.1 / math.sqrt(12 * 100))
    assert sorted(set(found["n_epochs"])) == [1, 2, 3]
    assert sorted(set(found["batch_size"])) == [32, 64]
    few = pd.DataFrame(drawn(tmp_path / "b", search=varied, trials=5))
    pd.testing.assert_frame_equal(found.head(5), few)
    assert not few.equals(pd.DataFrame(drawn(tmp_path / "c", search=varied, trials=5, seed=1)))
    # A search that is resumed has its trials again, and more trials continue it.
    again = pd.DataFrame(drawn(tmp_path / "b", search=varied, trials=8))
    pd.testing.assert_frame_equal(again.head(5), few)
    assert not again[["learning_rate", "gamma"]].duplicated().any()


class Racer:
    """Does the units of a search without training: a trial's progress is what a function says of its gamma."""

    def __init__(self, tuner: Tuner, progress) -> None:
        self.tuner, self.progress, self.raced = tuner, progress, []

    def run(self) -> pd.DataFrame:
        """Do all units, one after another, and return the results."""
        units: list[Unit] = self.tuner.first_units()
        seen: set[str] = set()
        while units:
            unit = units.pop(0)
            if unit.key in seen:
                continue
            seen.add(unit.key)
            if isinstance(unit, RaceUnit) and not unit.is_done(self.tuner.work):
                assert isinstance(unit.training, RungUnit)
                self.raced.append((unit.training.config.gamma, unit.seed, unit.training.steps))
                metres = self.progress(unit.training.config.gamma, unit.seed)
                rows = pd.DataFrame({"progress_m": metres, "outcome": ["crash", "timeout"], "mean_speed_mps": [1, 3]})
                write_rows(rows, unit.folder(self.tuner.work) / ROWS)
                (unit.folder(self.tuner.work) / "done.json").touch()
            units += self.tuner.on_done(unit)
        return self.tuner.results()


def test_trials_are_judged_by_the_progress_of_their_races(tmp_path: Path):
    tuner = Tuner(search(seeds=2, episodes=3, tracks=["Nightjar", "Foxglove"]), tmp_path)
    progress = {(0.9, 0): [10.0, 20.0], (0.9, 1): [30.0, 20.0], (0.99, 0): [40.0, 40.0], (0.99, 1): [0.0, 80.0]}
    found = Racer(tuner, lambda gamma, seed: progress[gamma, seed]).run()
    races = [race for trial in tuner.trials for rung in trial.races for race in rung]
    assert {(task.track, race.episodes) for race in races for task in race.tasks} == {("Nightjar", 2), ("Foxglove", 2)}
    assert found["trial"].tolist() == [1, 0]
    best = found.iloc[0]
    assert (best["gamma"], best["progress_m"], best["progress_low_m"], best["progress_high_m"]) == (0.99, 40, 40, 40)
    assert (best["crash_rate"], best["mean_speed_mps"]) == (0.5, 2.0)
    assert found["progress_low_m"].tolist() == [40.0, 15.0]


def test_trials_that_fall_behind_are_stopped_and_stay_so(tmp_path: Path):
    gammas = [0.95, 0.91, 0.96, 0.92, 0.93, 0.98, 0.94, 0.97]
    config = search(search={"gamma": gammas}, rungs=[0.125, 0.5], reduction_factor=2)
    racer = Racer(Tuner(config, tmp_path), lambda gamma, _: [gamma, gamma])
    found = racer.run()
    assert found["gamma"].iloc[0] == 0.98
    assert found["steps"].iloc[0] == 256
    # At the first rung, a trial continues if it is in the better half of the trials so far, itself included.
    assert sorted(steps for gamma, _, steps in racer.raced if gamma == 0.98) == [32, 128, 256]
    early = found[found["stopped_early"]]
    assert 4 <= len(early) < 8
    assert set(early["steps"]) <= {32, 128}
    assert found["stopped_early"].is_monotonic_increasing
    again = Racer(Tuner(config, tmp_path), lambda *_: pytest.fail("it is raced already"))
    pd.testing.assert_frame_equal(again.run(), found)


def test_values_are_drawn_near_the_best(tmp_path: Path):
    config = search(search={"gamma": {"uniform": [0.5, 1.0]}}, sampler="tpe", trials=40)
    tuner = Tuner(config, tmp_path, parallel=2)
    assert len(tuner.first_units()) == 2
    found = Racer(tuner, lambda gamma, _: [-abs(gamma - 0.8)] * 2).run()
    assert len(found) == 40
    later = found.loc[found["trial"] >= 20, "gamma"].to_numpy(np.float64)
    assert np.abs(later - 0.8).mean() < 0.06  # 0.13 at random


def test_values_that_are_drawn_again_are_judged_without_work(tmp_path: Path):
    tuner = Tuner(search(sampler="tpe", trials=4, rungs=[0.5]), tmp_path)
    racer = Racer(tuner, lambda gamma, _: [gamma, gamma])
    found = racer.run()
    assert len(found) == 4
    assert not any(trial.is_open for trial in tuner.trials)
    assert len(set(racer.raced)) == len(racer.raced) <= 4


def test_a_training_that_fails_makes_room_for_the_next_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail_twice(unit: RungUnit, work: Path, report: Report) -> None:
        if len(failed) < 2:
            failed.append(unit.config.gamma)
            raise ValueError("no luck")

    def race(unit: RaceUnit, work: Path, report: Report) -> None:
        rows = pd.DataFrame({"progress_m": [1.0], "outcome": ["timeout"], "mean_speed_mps": [1.0]})
        write_rows(rows, unit.folder(work) / ROWS)

    failed: list[float] = []
    monkeypatch.setattr("outlap.experiments.workers.ProcessPoolExecutor", OneProcess)
    monkeypatch.setattr(RungUnit, "do", fail_twice)
    monkeypatch.setattr(RaceUnit, "do", race)
    varied = {"gamma": {"uniform": [0.9, 0.99]}}
    config = search(search=varied, sampler="tpe", trials=4)
    tuner = Tuner(config, tmp_path)
    with pytest.raises(OutlapError, match="2 of 6 units of work failed"):
        run_units(tuner.first_units(), tuner.work, LocalEngine(1), on_done=tuner.on_done, on_failed=tuner.on_failed)
    assert [trial.values["gamma"] for trial in tuner.trials[:2]] == failed
    again = Tuner(config, tmp_path)
    assert [trial.is_open for trial in again.trials] == [True, True, False, False]
    run_units(again.first_units(), again.work, LocalEngine(1), on_done=again.on_done, on_failed=again.on_failed)
    assert np.isfinite(again.results()["progress_m"]).all()
    assert len(again.results()) == 4


def test_values_that_are_drawn_again_after_a_failure_fail_too(tmp_path: Path):
    tuner = Tuner(search(search={"gamma": [0.9]}, sampler="tpe", trials=3), tmp_path)
    (unit,) = tuner.first_units()
    assert tuner.on_failed(unit) == []
    assert [trial.is_open for trial in tuner.trials] == [False] * 3


def test_a_changed_file_keeps_the_units_of_the_trials_that_it_still_has(tmp_path: Path):
    def keys(**varied) -> set[str]:
        tuner = started(tmp_path, search=varied, seeds=2)
        return {unit.key for trial in tuner.trials for unit in (*trial.rungs[0], *trial.races[0])}

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
        ({"rungs": [0.5, 0.125]}, "must be shares of the steps in increasing order"),
        ({"rungs": [0.5, 1.0]}, "must be shares of the steps in increasing order"),
    ],
)
def test_a_file_that_is_wrong_is_said(changes: dict, message: str):
    with pytest.raises(ValidationError) as error:
        search(**changes)
    assert message in str(error.value)


def test_trials_that_cannot_be_are_said_before_the_first_begins(tmp_path: Path):
    with pytest.raises(OutlapError, match=r"trial with gamma 1.5: gamma is 1.5; must be <= 1"):
        started(tmp_path, search={"gamma": [0.9, 1.5]})
    with pytest.raises(OutlapError, match="gama is not a known field; did you mean gamma"):
        started(tmp_path, search={"gama": [0.9]})
    with pytest.raises(OutlapError, match=r"search.gamma is a range, of which trials are drawn; say how many"):
        started(tmp_path, search={"gamma": {"uniform": [0.9, 0.99]}})
    with pytest.raises(OutlapError, match="algorithm is 'dqn'; must be one of ppo"):
        started(tmp_path, algorithm="dqn")


def test_a_search_trains_races_and_names_the_best(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    import yaml

    file = tmp_path / "mine.yaml"
    content = {"algorithm": "ppo", "training": TINY, "search": {"gamma": [0.9, 0.99]}, "episodes": 2, "time_limit": 1}
    file.write_text(yaml.safe_dump(content))
    out = tmp_path / "out"
    assert main(["tune", str(file), "--out", str(out), "--quiet"]) == 0
    found = pd.read_parquet(out / "trials.parquet")
    assert sorted(found["gamma"]) == [0.9, 0.99]
    assert np.isfinite(found["progress_m"]).all()
    assert load_config(PPOConfig, out / "best.yaml").gamma == found["gamma"].iloc[0]
    assert f"outlap train ppo --config {out / 'best.yaml'}" in capsys.readouterr().out
    done = {path: path.stat().st_mtime_ns for path in (out / "work").rglob("done.json")}
    assert len(done) == 4
    # Values that are drawn twice, or that another file has had before, are not trained again.
    file.write_text(yaml.safe_dump({**content, "search": {"gamma": [0.99, 0.99, 0.9]}}))
    assert main(["tune", str(file), "--out", str(out), "--quiet"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "work").rglob("done.json")} == done
    again = pd.read_parquet(out / "trials.parquet").set_index("trial")
    assert again["gamma"].to_dict() == {0: 0.99, 1: 0.99, 2: 0.9}
    assert again["progress_m"].tolist()[0] == again["progress_m"].tolist()[1]


def test_a_rung_continues_the_training_of_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("outlap.experiments.workers.ProcessPoolExecutor", OneProcess)
    config = search(search={"gamma": [0.9]}, rungs=[0.25, 0.5], episodes=1, time_limit=0.5)
    tuner = Tuner(config, tmp_path)
    run_units(tuner.first_units(), tuner.work, on_done=tuner.on_done)
    runs = [load_run(rung[0].folder(tuner.work)) for rung in tuner.trials[0].rungs]
    assert [run.finished for run in runs] == [False, False, True]
    assert [len(run.record().get("resumed", [])) for run in runs] == [0, 1, 2]
    assert [run.checkpoints()[0].stem for run in runs[:2]] == ["step_000000064", "step_000000128"]
    assert tuner.results()["steps"].tolist() == [256]


def test_a_training_that_diverges_ends_its_trial_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def diverging(config, folder, **keywords):
        if config.gamma == 0.9:
            raise TrainingDiverged("log_std is NaN")
        return train(config, folder, **keywords)

    monkeypatch.setattr("outlap.experiments.workers.ProcessPoolExecutor", OneProcess)
    monkeypatch.setattr("outlap.experiments.tune.train", diverging)
    config = search(episodes=1, time_limit=0.5)
    for _ in range(2):
        tuner = Tuner(config, tmp_path)
        run_units(tuner.first_units(), tuner.work, on_done=tuner.on_done)
        found = tuner.results()
        assert found["gamma"].tolist() == [0.99, 0.9]
        assert np.isnan(found["progress_m"].iloc[1])
