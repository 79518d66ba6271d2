"""Training a population: what it leaves, that it goes on where it was, and who enters the manifest."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import PPO

from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import MANIFEST, Member, file_hashes, load_population, read_manifest
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.simulator.vehicle import VehicleParams
from outlap.training.population import SLOWEST, Opponent, Plan, enter, opponent_config, train_population, verify
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


class OneProcess(Executor):
    """Trains in this process what a pool would train in others."""

    def __init__(self, max_workers: int, mp_context: Any, initializer: Callable[..., None], initargs: tuple) -> None:
        initializer(*initargs)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except BaseException as error:
            future.set_exception(error)
        return future


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("outlap.training.population.ProcessPoolExecutor", OneProcess)
    monkeypatch.setattr("outlap.training.population._steps", None)  # which a worker keeps


class Trained(NamedTuple):
    plan: Plan
    found: list[tuple[Opponent, pd.DataFrame, bool]]  # what the training yielded
    reports: list[tuple[int, str]]
    environment_changed: bool


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A population, the training of whose first member was stopped halfway and gone on with."""
    folder = tmp_path_factory.mktemp("population")
    track = ring(radius=5.0)
    map_folder = str(track.save(folder / "maps" / track.name))
    plan = Plan(TINY, folder / "mine", track, map_folder, OPPONENTS, laps=1, starts=2, command="outlap made this")
    stopped_after(256, opponent_config(TINY, map_folder, 2.0), plan.folder / "runs" / "ring-2.0")
    before = dict(os.environ)
    reports: list[tuple[int, str]] = []
    found = list(train_population(plan, jobs=2, on_progress=lambda steps, note: reports.append((steps, note))))
    return Trained(plan, found, reports, before != dict(os.environ))


def test_every_opponent_is_trained_and_verified(trained: Trained) -> None:
    assert {opponent for opponent, _, _ in trained.found} == set(OPPONENTS)
    for opponent, rows, passed in trained.found:
        assert rows["driver"].tolist() == [opponent.name] * 2
        assert rows["track"].tolist() == ["ring5"] * 2
        assert passed == (rows["completed_laps"].to_numpy() >= 1).all()
        run = load_run(trained.plan.folder / "runs" / opponent.name)
        assert run.finished
        assert run.record()["steps"] == 512
        env = run.config.env
        assert (env.num_cars, env.vehicle.v_max, env.speed_range) == (
            1,
            opponent.max_speed_mps,
            (0.5, env.vehicle.v_max),
        )
    passed_names = {opponent.name for opponent, _, passed in trained.found if passed}
    assert {member.name for member in read_manifest(trained.plan.folder, may_be_empty=True)} == passed_names


@pytest.mark.parametrize("opponent", OPPONENTS, ids=lambda each: each.name)
def test_its_files_drive_as_its_policy_does(trained: Trained, opponent: Opponent) -> None:
    ours = MLPDriver.load(trained.plan.folder / opponent.name)
    assert (ours.name, ours.speeds, ours.beams) == (opponent.name, (SLOWEST, opponent.max_speed_mps), 8)
    model = PPO.load(trained.plan.folder / "runs" / opponent.name / "policy.zip", device="cpu")
    rng = np.random.default_rng(0)
    seen = {name: rng.normal(size=(20, size)).astype(np.float32) for name, size in ours.sizes.items()}
    np.testing.assert_allclose(ours.act(seen), model.predict(seen, deterministic=True)[0], atol=1e-5)


def test_a_stopped_training_goes_on_and_no_other_one_is_resumed(trained: Trained) -> None:
    sessions = {
        each.name: len(load_run(trained.plan.folder / "runs" / each.name).record().get("resumed", []))
        for each in OPPONENTS
    }
    assert sessions == {"ring-2.0": 1, "ring-3.0": 0}


def test_progress_is_of_all_trainings_together(trained: Trained) -> None:
    steps = [done for done, _ in trained.reports]
    assert steps == sorted(steps)
    assert steps[-1] == 2 * 512
    assert {name for _, note in trained.reports for name in note.split(", ")} == {"ring-2.0", "ring-3.0"}
    assert not trained.environment_changed


def test_the_same_plan_again_trains_nothing_anew(trained: Trained, one_process: None) -> None:
    folder = trained.plan.folder
    kept = [folder / "runs" / each.name / file for each in OPPONENTS for file in ("policy.zip", "run.json")]
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in kept]
    files = {each.name: file_hashes(folder, each.name) for each in OPPONENTS}
    (folder / "ring-2.0.safetensors").unlink()
    steps: list[int] = []
    again = list(train_population(trained.plan, jobs=1, on_progress=lambda done, _: steps.append(done)))
    assert steps[-1] == 2 * 512
    assert [(path.read_bytes(), path.stat().st_mtime_ns) for path in kept] == before
    assert {each.name: file_hashes(folder, each.name) for each in OPPONENTS} == files
    first = {opponent.name: rows for opponent, rows, _ in trained.found}
    for opponent, rows, _ in again:
        pd.testing.assert_frame_equal(rows, first[opponent.name])


@pytest.mark.parametrize(
    "settings",
    [TINY.model_copy(update={"seed": 1}), TINY.model_copy(update={"total_steps": 1024})],
    ids=["seed", "steps"],
)
def test_another_configuration_in_the_same_folder_is_named(trained: Trained, settings: PPOConfig) -> None:
    with pytest.raises(OutlapError, match=r"runs/ring-2\.0: was begun with another configuration; take another --out"):
        next(train_population(replace(trained.plan, settings=settings), jobs=1))


def test_only_those_that_passed_are_in_the_manifest(
    trained: Trained, one_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def verified(driver: MLPDriver, *_: Any) -> pd.DataFrame:
        return verification(3, 3) if driver.name == "ring-3.0" else verification(3, 2)

    monkeypatch.setattr("outlap.training.population.verify", verified)
    plan = replace(trained.plan, folder=Path(shutil.copytree(trained.plan.folder, tmp_path / "copy")), laps=3)
    assert {opponent.name: passed for opponent, _, passed in train_population(plan)} == {
        "ring-2.0": False, "ring-3.0": True,
    }  # fmt: skip
    (member,) = read_manifest(plan.folder)
    assert (member.name, member.split, member.track, member.command) == (
        "ring-3.0", "held_out", "ring5", "outlap made this",
    )  # fmt: skip
    assert (plan.folder / "ring-2.0.safetensors").is_file()


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
