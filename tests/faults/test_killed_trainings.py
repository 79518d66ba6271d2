"""Trainings killed at random moments: they go on, and nothing is lost, doubled or half there."""

from __future__ import annotations

import shutil
import signal
import time
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from stable_baselines3.common.save_util import load_from_zip_file

from commands import Commands, leftovers
from outlap.cli.main import main
from outlap.experiments.figures import read_learning
from outlap.mql.replay import ReplayBuffer
from outlap.training.run import Run, load_run

pytestmark = pytest.mark.slow

ENV = [
    "--env.tracks", "Foxglove", "--env.no-augment-tracks", "--env.beams", "8", "--env.termination.time-limit", "0.6",
    "--num-envs", "4", "--threads", "1", "--seed", "3", "--quiet",
]  # fmt: skip
TOTAL = {"ppo": 2048, "mql": 512}
TINY = {
    "ppo": ["--total-steps", "2048", "--checkpoint-every", "1024", "--n-steps", "16", "--batch-size", "64",
            "--n-epochs", "1", "--net-arch", "8"],
    "mql": ["--total-steps", "512", "--checkpoint-every", "256", "--learning-starts", "32", "--batch-size", "16",
            "--buffer-size", "4000", "--updates-per-step", "1"],
}  # fmt: skip
EVENTS = 1000  # bytes of a log with its first rows


def weights(run: Run) -> np.ndarray:
    _, parameters, _ = load_from_zip_file(run.policy_path, device="cpu")
    assert parameters is not None
    return np.concatenate([value.numpy().ravel() for value in parameters["policy"].values()])


def resumed(algorithm: str, folder: Path) -> Run:
    """The run, gone on with to its end."""
    torch.set_num_threads(1)
    # TensorBoard orders the files of a log by the second of their names, and then by the process: a resumed training in
    # a process of its own begins later than that.
    time.sleep(1.1)
    assert main(["train", algorithm, "--resume", str(folder), "--quiet"]) == 0
    return load_run(folder)


def check_whole(run: Run) -> None:
    """Nothing is lost, doubled or half there."""
    assert run.finished
    total = TOTAL[run.config.algorithm]
    assert run.record()["steps"] == total
    assert run.record()["seed"] == 3  # who began it was noted before the first kill
    assert leftovers(run.folder) == []
    for path in (run.policy_path, *run.checkpoints()):
        assert zipfile.ZipFile(path).testzip() is None
    # What was noted beyond the checkpoint that the last session began from is in no curve beside what came instead.
    last = max(run.folder.glob("tensorboard/events*"), key=lambda log: log.stat().st_mtime_ns)
    alone = run.folder / "last" / "tensorboard"
    alone.mkdir(parents=True)
    shutil.copy(last, alone)
    came_instead = read_learning(alone.parent)
    curve = read_learning(run.folder)
    steps = curve["step"].to_numpy()
    assert len(came_instead)
    assert len(np.unique(steps)) == len(steps)
    assert curve[curve["step"] >= came_instead["step"][0]].reset_index(drop=True).equals(came_instead)
    if run.config.algorithm == "ppo":  # a row every 64 actions, from the first episode that ended
        np.testing.assert_array_equal(steps, np.arange(int(steps[0]), total + 1, 64))
    else:
        assert ReplayBuffer.load(run.replay_path).transitions() == total


@pytest.mark.parametrize("algorithm", ["ppo", "mql"])
def test_a_training_that_is_killed_twice(algorithm: str, commands: Commands, tmp_path: Path) -> None:
    words = ["train", algorithm, *ENV, *TINY[algorithm], "--out"]
    folder = tmp_path / "run"

    def has_begun() -> bool:
        return any(log.stat().st_size > EVENTS for log in folder.glob("tensorboard/events*"))

    code = commands.ended_by(signal.SIGKILL, [*words, "run"], tmp_path, has_begun).code
    assert code == -signal.SIGKILL
    # Before its first checkpoint it begins anew: bit for bit as if nothing had been.
    assert not load_run(folder).checkpoints()
    again = resumed(algorithm, shutil.copytree(folder, tmp_path / "again"))
    assert main([*words, str(tmp_path / "undisturbed")]) == 0
    undisturbed = load_run(tmp_path / "undisturbed")
    np.testing.assert_array_equal(weights(again), weights(undisturbed))
    assert read_learning(again.folder).equals(read_learning(undisturbed.folder))
    check_whole(again)

    def has_checkpoint() -> bool:
        return bool(list(folder.glob("checkpoints/step_*.zip")))

    commands.ended_by(
        signal.SIGKILL, ["train", algorithm, "--resume", "run"], tmp_path, has_checkpoint, within=0.2, seed=1
    )
    kept = load_run(folder).checkpoints()[0]
    # And so it does from a checkpoint.
    final = resumed(algorithm, folder)
    assert kept in final.checkpoints()
    np.testing.assert_array_equal(weights(final), weights(undisturbed))
    assert read_learning(final.folder).equals(read_learning(undisturbed.folder))
    check_whole(final)


def test_adaptations_that_are_killed_end_with_the_same_rows(commands: Commands, tmp_path: Path) -> None:
    run, killed, whole = (str(tmp_path / name) for name in ("run", "killed", "whole"))
    assert main(["train", "mql", *ENV, *TINY["mql"], "--out", run]) == 0
    words = ["adapt", run, "--tracks", "Foxglove", "--seeds", "2", "--clip", "none", "abc", "--episodes", "3"]
    words += ["--iterations", "2", "--collect-steps", "10", "--time-limit", "2", "--quiet"]
    for part in ("before", "abc-0"):
        commands.ended_by(
            signal.SIGKILL, [*words, "--out", killed, "--jobs", "1"], tmp_path,
            lambda part=part: any((tmp_path / "killed" / "work").glob(f"*/*-{part}-*/done.json")), within=0.3,
        )  # fmt: skip
    assert main([*words, "--out", killed]) == 0
    assert main([*words, "--out", whole]) == 0
    for name in ("episodes.parquet", "updates.parquet"):
        pd.testing.assert_frame_equal(pd.read_parquet(f"{killed}/{name}"), pd.read_parquet(f"{whole}/{name}"))
    assert sorted(path.name for path in Path(killed).iterdir()) == sorted(path.name for path in Path(whole).iterdir())
