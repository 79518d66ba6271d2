"""Fixtures that every test folder uses."""

from __future__ import annotations

import os
from pathlib import Path

import numba
import pytest


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """A handful of worlds is no work for two threads; tests of threading set a number of their own."""
    numba.set_num_threads(1)


@pytest.fixture(scope="session")
def real_tracks() -> Path:
    """The first folder of OUTLAP_TRACKS, which holds real circuits in F1TENTH format; skips where there is none."""
    for folder in filter(None, os.environ.get("OUTLAP_TRACKS", "").split(os.pathsep)):
        if Path(folder).is_dir():
            return Path(folder)
    pytest.skip("needs real circuits: set OUTLAP_TRACKS to a folder of them")
