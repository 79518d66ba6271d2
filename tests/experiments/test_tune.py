"""Searches with Ray Tune: what is kept of them, and whose they are. Those on a cluster are in test_ray_engine.py."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("ray", reason="needs Ray: pip install 'outlap[distributed]'")

from ray import cloudpickle

from outlap.errors import OutlapError
from outlap.experiments import tune
from outlap.experiments.sweep import SweepConfig
from outlap.experiments.tune import tune_trials

SWEEP = SweepConfig(algorithm="ppo", search={"gamma": (0.9, 0.99)})


def test_what_is_restored_tells_whoever_listens_now():
    # A progress bar of a terminal holds a lock, which no pickle takes.
    lock, told = threading.RLock(), []
    done, running = (
        SimpleNamespace(is_finished=lambda finished=finished: finished, status=status)
        for finished, status in ((True, "TERMINATED"), (False, "RUNNING"))
    )
    listening = tune.LISTENER.set(lambda *counts: told.append((lock, counts)))
    try:
        kept = cloudpickle.dumps(tune._watch())  # type: ignore[attr-defined]
    finally:
        tune.LISTENER.reset(listening)
    restored = cloudpickle.loads(kept)
    restored.on_step_end(0, [done, running])
    assert not told
    listening = tune.LISTENER.set(lambda *counts: told.append((lock, counts)))
    try:
        restored.on_step_end(1, [done, running, done])
    finally:
        tune.LISTENER.reset(listening)
    assert told == [(lock, (2, 1))]


@pytest.mark.parametrize("flag", ["--out", "--store"])
def test_another_sweep_is_refused_where_one_was_begun(flag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(address: str | None) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tune, "ray_cluster", interrupted)
    store = f"file://{tmp_path / 'store'}" if flag == "--store" else None
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            tune_trials(SWEEP, tmp_path / "my out", store=store)
    for changes, names in (
        ({"search": {"gamma": (0.9, 0.95)}}, "search"),
        ({"seed": 1}, "seed"),
        ({"trials": 3, "training": {"n_epochs": 2}}, "training, trials"),
    ):
        with pytest.raises(OutlapError, match=f"a search with other {names} was begun there; give another {flag}"):
            tune_trials(SWEEP.model_copy(update=changes), tmp_path / "my out", store=store)


def test_a_search_that_nobody_knows_the_sweep_of_is_refused(tmp_path: Path):
    (tmp_path / "tune").mkdir()
    with pytest.raises(OutlapError, match=f"{tmp_path}: a search with other algorithm, .* was begun there"):
        tune_trials(SWEEP, tmp_path)
