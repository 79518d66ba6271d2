"""Ctrl-C in commands that work long: they end soon, say how to go on, and leave what is promised; never a traceback."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from commands import Commands, Ended, leftovers
from outlap.cli.main import main
from outlap.training.run import load_run

pytestmark = pytest.mark.slow

SOON = 10.0  # [s]
SMALL = [
    "--env.tracks", "Foxglove", "--env.no-augment-tracks", "--env.beams", "8", "--num-envs", "4", "--threads", "1",
]  # fmt: skip
LONG = ["--total-steps", "1_000_000_000"]
META = ["--learning-starts", "32", "--batch-size", "16", "--buffer-size", "4000"]
ROLLOUT = ["--n-steps", "16", "--batch-size", "64", "--n-epochs", "1", "--net-arch", "8"]
NOTHING_KEPT = "nothing is kept; begin again with the same command"


def check_ended(ended: Ended, command: str, said: str) -> None:
    assert ended.code in (130, -signal.SIGINT)  # 130 to a shell, both of them
    assert ended.seconds < SOON
    assert "Traceback" not in ended.said
    assert said in ended.said
    assert ended.said.endswith(f"outlap {command}: interrupted\n")


def exists(folder: Path, pattern: str) -> Callable[[], bool]:
    return lambda: any(folder.glob(pattern))


@pytest.mark.parametrize(("algorithm", "tiny"), [("mql", META), ("recurrent-ppo", [*ROLLOUT, "--lstm-hidden", "8"])])
def test_a_training_saves_and_says_how_to_go_on(
    algorithm: str, tiny: list[str], commands: Commands, tmp_path: Path
) -> None:
    words = ["train", algorithm, *SMALL, *tiny, *LONG, "--out", "my run"]
    ended = commands.ended_by(signal.SIGINT, words, tmp_path, exists(tmp_path, "my run/tensorboard/*"), within=1.0)
    check_ended(ended, f"train {algorithm}", f"saved; go on with: outlap train {algorithm} --resume 'my run'\n")
    run = load_run(tmp_path / "my run")
    assert run.record()["steps"] == int(run.checkpoints()[0].stem.removeprefix("step_"))
    assert leftovers(run.folder) == []


def test_what_has_not_begun_is_not_said_to_be_saved(commands: Commands, tmp_path: Path) -> None:
    ended = commands.ended_by(signal.SIGINT, ["train", "ppo", *LONG, "--out", "run"], tmp_path, lambda: True, 0.6)
    assert ended.code in (130, -signal.SIGINT)
    assert "saved" not in ended.said
    assert not (tmp_path / "run" / "config.yaml").exists()


def test_opponents_are_saved_in_their_own_processes(commands: Commands, tmp_path: Path) -> None:
    words = ["opponents", "train", "--track", "Foxglove", "--speeds", "2:2:1", "--held-out", "3", "--jobs", "1"]
    words += ["--env.reward.preset", "fast"]  # no line need be planned for it
    words += [*SMALL[3:], *ROLLOUT, *LONG, "--out", "mine"]
    ended = commands.ended_by(
        signal.SIGINT, words, tmp_path, exists(tmp_path, "mine/work/opponents/*/runs/*/tensorboard/*"), within=0.5
    )
    check_ended(ended, "opponents train", "saved; go on with the same command\n")
    (run,) = (tmp_path / "mine/work/opponents").glob("*/runs/*")
    assert load_run(run).checkpoints()
    assert leftovers(tmp_path) == []


SEARCH = """
algorithm: ppo
training:
  total_steps: 16384
  num_envs: 4
  n_steps: 16
  batch_size: 64
  n_epochs: 1
  net_arch: [8]
  checkpoint_every: 1024
  env: {tracks: [Foxglove], augment_tracks: false, beams: 8, termination: {time_limit: 1.0}}
search: {gamma: [0.9, 0.99]}
"""


def test_a_search_goes_on_with_the_same_command(
    commands: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna", reason="needs Optuna: pip install 'outlap[tune]'")
    (tmp_path / "search.yaml").write_text(SEARCH)
    words = ["tune", "search.yaml", "--out", "out", "--jobs", "1", "--quiet"]
    ended = commands.ended_by(
        signal.SIGINT, words, tmp_path, exists(tmp_path, "out/work/rungs/*/checkpoints/step_*.zip"), within=0.5
    )
    check_ended(ended, "tune", "saved; go on with the same command\n")
    assert not (tmp_path / "out" / "trials.parquet").exists()
    monkeypatch.chdir(tmp_path)
    assert main(words) == 0
    found = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert sorted(found["trial"]) == [0, 1]
    resumed = [load_run(path).record().get("resumed", []) for path in (tmp_path / "out/work/rungs").iterdir()]
    assert sorted(map(len, resumed)) == [0, 1]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A meta-training."""
    folder = tmp_path_factory.mktemp("meta") / "run"
    assert main(["train", "mql", *SMALL, *META, "--total-steps", "64", "--out", str(folder), "--quiet"]) == 0
    return folder


def test_races_leave_nothing_half_done(run: Path, commands: Commands, tmp_path: Path) -> None:
    words = ["evaluate", str(run), "--tracks", "Foxglove", "--episodes", "100_000", "--time-limit", "2", "--out", "out"]
    ended = commands.ended_by(signal.SIGINT, [*words, "--quiet"], tmp_path, exists(tmp_path, "out"), within=1.0)
    check_ended(ended, "evaluate", f"{NOTHING_KEPT}\n")
    assert not any(tmp_path.glob("out/*"))  # so that the same command can begin again


def test_adaptations_that_are_done_are_kept(run: Path, commands: Commands, tmp_path: Path) -> None:
    words = [
        "adapt",
        str(run),
        "--tracks",
        "Foxglove",
        "--seeds",
        "10_000",
        "--iterations",
        "1",
        "--collect-steps",
        "10",
    ]
    words += ["--episodes", "2", "--record", "1", "--time-limit", "2", "--out", "out", "--quiet"]
    ended = commands.ended_by(signal.SIGINT, words, tmp_path, exists(tmp_path, "out/work/adaptations/*/done.json"), 1.0)
    check_ended(ended, "adapt", f"saved; go on with: outlap adapt {run} ")
    assert leftovers(tmp_path / "out") == []
