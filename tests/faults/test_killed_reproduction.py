"""`outlap reproduce`, killed and interrupted: the same command goes on, and finds what it would have found."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from commands import Commands, leftovers
from one_process import OneProcess
from outlap.cli.main import main

pytestmark = pytest.mark.slow

BUDGET = """
title: as little as can be
built_in: true
seeds: 1
episodes: 20
training:
  all: {num_envs: 4, checkpoint_every: 1000000, env: {augment_tracks: false, beams: 8}}
  ppo: {total_steps: 512, n_steps: 16, batch_size: 64, n_epochs: 1, net_arch: [8]}
"""
TASKS = """
title: one circuit
circuits: [{title: built-in, train: [Foxglove], held_out: [Nightjar]}]
tables: {alone: {title: Alone, circuits: train}}
"""
WORDS = [
    "reproduce", "one-circuit.yaml", "--budget", "tiny.yaml", "--methods", "vanilla-dr", "--jobs", "1",
    "--quiet", "--out",
]  # fmt: skip


def numbers(folder: Path) -> Any:
    """What results.json says, but for where it comes from."""
    content = json.loads((folder / "results.json").read_text())
    del content["record"]
    return content


def test_a_reproduction_that_is_killed_and_interrupted(
    commands: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tiny.yaml").write_text(BUDGET)
    (tmp_path / "one-circuit.yaml").write_text(TASKS)
    monkeypatch.chdir(tmp_path)
    work = tmp_path / "stopped" / "work"

    def trains() -> bool:
        return any(work.glob("trainings/*/tensorboard/*"))

    def races() -> bool:
        return any(work.glob("races/*/.lock"))

    words = [*WORDS, "stopped"]
    assert commands.ended_by(signal.SIGKILL, words, tmp_path, trains, within=0.2).code == -signal.SIGKILL
    interrupted = commands.ended_by(signal.SIGINT, words, tmp_path, races, within=0.3, seed=1)
    assert interrupted.code in (130, -signal.SIGINT)
    assert interrupted.seconds < 10.0
    assert interrupted.said == "\nsaved; go on with the same command\noutlap reproduce: interrupted\n"
    assert not (tmp_path / "stopped" / "results.json").exists()
    monkeypatch.setattr("outlap.experiments.workers.ProcessPoolExecutor", OneProcess)
    for folder in ("stopped", "undisturbed"):
        assert main([*WORDS, folder]) == 0
    rows, same = (pd.read_parquet(tmp_path / folder / "episodes.parquet") for folder in ("stopped", "undisturbed"))
    pd.testing.assert_frame_equal(rows, same)
    assert not rows.duplicated(["method", "task", "seed"]).any()
    assert numbers(tmp_path / "stopped") == numbers(tmp_path / "undisturbed")
    assert leftovers(tmp_path) == []
