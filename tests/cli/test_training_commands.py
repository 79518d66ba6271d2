"""`outlap train ppo`, `benchmark simulator` and `demo` as a user calls them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from outlap.cli.main import main
from outlap.track.map_io import write_track
from synthetic_tracks import ring

SMALL = [
    "--env.tracks", "ring5", "--env.beams", "8", "--env.no-augment-tracks", "--num-envs", "4", "--n-steps", "8",
    "--batch-size", "32", "--n-epochs", "1", "--net-arch", "8", "--checkpoint-every", "32",
]  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder of its own, from which a ring has a name."""
    write_track(ring(radius=5.0), tmp_path / "maps" / "ring5")
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path / "maps"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_train_then_train_on(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "ppo", *SMALL, "--total-steps", "64", "--out", "run", "--json", "-", "--quiet"]) == 0
    out, _ = capfd.readouterr()
    data = json.loads(out)
    assert data["steps"] == 64
    assert data["env_steps_per_second"] > 0
    assert Path(data["policy"]).is_file()
    assert main(["train", "ppo", "--resume", "run"]) == 0
    out, _err = capfd.readouterr()
    assert "run folder: run" in out


def test_a_configuration_file_is_overridden_by_flags(here: Path) -> None:
    (here / "mine.yaml").write_text("total_steps: 32\nseed: 5\nenv: {tracks: [ring5], beams: 8}\n")
    assert main(["train", "ppo", "--config", "mine.yaml", *SMALL, "--seed", "6", "--out", "run", "--quiet"]) == 0
    saved = (here / "run" / "config.yaml").read_text()
    assert "seed: 6" in saved
    assert "total_steps: 32" in saved


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--env.beams", "2000"], "beams"),
        (["--n-steps", "many"], "n-steps"),
        (["--no-such-flag"], "no-such-flag"),
        (["--env.tracks", "nowhere"], "no track is called 'nowhere'"),
        (["--resume", "nowhere"], "is not a run folder"),
        (["--resume", "nowhere", "--seed", "3"], "leave the other flags out"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(words: list[str], said: str, capfd: pytest.CaptureFixture[str]) -> None:
    out_folder = [] if "--resume" in words else ["--out", "run"]
    assert main(["train", "ppo", *words, *out_folder]) == 2
    out, err = capfd.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    assert said in err
    assert not Path("run").exists()


def test_ctrl_c_keeps_the_work_and_says_how_to_go_on(here: Path) -> None:
    command = [sys.executable, "-m", "outlap", "train", "ppo", *SMALL, "--total-steps", "100000000", "--out", "run"]
    process = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_NUM_THREADS": "1"},
        # A test run in the background hands down an ignored SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 240.0  # the kernels may have to be compiled first
    while not list((here / "run" / "checkpoints").glob("step_*.zip")) and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    try:
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "outlap train ppo --resume run" in err
    assert "Traceback" not in err


def test_benchmark_rows(capfd: pytest.CaptureFixture[str]) -> None:
    words = ["--worlds", "4", "--cars", "2", "--beams", "9", "--tracks", "ring5", "--seconds", "0.05", "--json", "-"]
    assert main(["benchmark", "simulator", *words]) == 0
    (row,) = json.loads(capfd.readouterr().out)["rows"]
    assert (row["cars"], row["beams"], row["worlds"]) == (2, 9, 4)
    assert row["env_steps_per_second"] > 0
    assert row["peak_memory_mb"] > 0


def test_benchmark_refuses_half_a_case(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "simulator", "--cars", "2"]) == 2
    assert "--cars and --beams go together" in capfd.readouterr().err


def test_demo_trains_and_races_on_circuits_it_never_saw(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it, but for one iteration of the ten, and races of 5 s."""
    from outlap.cli.adapt import Adapt
    from outlap.track.generate import BUILTIN_HELD_OUT

    monkeypatch.setattr("outlap.cli.adapt.Adapt", partial(Adapt, iterations=1, time_limit=5.0))
    assert main(["demo", "--steps", "100", "--episodes", "1", "--out", "run", "--json", "-", "--quiet"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["training"]["steps"] >= 100
    for method in ("before", "abc"):
        assert set(data["adaptation"][method]["tracks"]) == set(BUILTIN_HELD_OUT)
    assert (Path(data["adaptation"]["folder"]) / "episodes.parquet").is_file()
