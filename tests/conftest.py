"""Fixtures that every test folder uses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

# Tests run side by side, one a core. OpenMP reads this when PyTorch loads it; child processes inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """A handful of worlds is no work for two threads; tests of threading set a number of their own."""
    numba.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def shared_cache(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Iterator[None]:
    """Lines are planned once for all tests; the user's cache and the system's temporary folder are left alone."""
    base = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(base / "sb3-logs"))  # of models that a test trains outside of a session
        patch.setenv("OUTLAP_CACHE", str((base if worker_id == "master" else base.parent) / "outlap-cache"))
        yield


@pytest.fixture(scope="session")
def real_tracks() -> Path:
    """The first folder of OUTLAP_TRACKS, which holds real circuits in F1TENTH format; skips where there is none."""
    for folder in filter(None, os.environ.get("OUTLAP_TRACKS", "").split(os.pathsep)):
        if Path(folder).is_dir():
            return Path(folder)
    pytest.skip("needs real circuits: set OUTLAP_TRACKS to a folder of them")
