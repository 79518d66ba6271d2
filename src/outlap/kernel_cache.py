"""Throws compiled kernels away when any source that they were compiled from has changed.

Numba keeps compiled functions on disk and looks at a function's own file to see whether they are still good; what
that file imports it does not look at. After an update a kernel could then run with another version's memory
layout, and crash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from outlap.files import atomic_write


def discard_stale_kernels(probe: Any, sources: Iterable[Path]) -> None:
    """Delete a folder's compiled functions unless they are of today's sources. Call before the first is used.

    Args:
        probe: any function of the folder, decorated with `njit(cache=True)`: it knows where the folder's cache is.
        sources: all files that its functions are compiled from.
    """
    path = probe.stats.cache_path
    if path is None:  # caching is switched off
        return
    folder = Path(path)
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    stamp = folder / "sources.sha256"
    with suppress(OSError):
        if stamp.exists() and stamp.read_text() == digest:
            return
        for compiled in folder.glob("*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        atomic_write(stamp, digest)
