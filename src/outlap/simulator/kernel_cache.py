"""Throws compiled kernels away when any source that they were compiled from has changed.

Numba keeps compiled functions on disk and looks at a function's own file to see whether they are still good; what
that file imports it does not look at. After an update a kernel could then run with another version's memory
layout, and crash.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from numba import njit

from outlap.files import atomic_write

PACKAGE = Path(__file__).resolve().parents[1]


@njit(cache=True)
def _probe():  # its cache is where the cache of this folder's functions is
    return 0


def discard_stale_kernels() -> None:
    """Delete this folder's compiled functions unless they are of today's sources. Call before the first is used."""
    path = _probe.stats.cache_path
    if path is None:  # caching is switched off
        return
    folder = Path(path)
    sources = [
        *sorted((PACKAGE / "simulator").glob("*.py")),
        PACKAGE / "seeding.py",
        PACKAGE / "track" / "centerline.py",
    ]
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    stamp = folder / "sources.sha256"
    with suppress(OSError):
        if stamp.exists() and stamp.read_text() == digest:
            return
        for compiled in folder.glob("*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        atomic_write(stamp, digest)
