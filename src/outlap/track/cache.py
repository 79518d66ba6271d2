"""The user's track cache: one writer at a time, and a track is either wholly there or not at all.

A track is prepared in a hidden folder inside the cache and renamed into place. The lock is the operating
system's, so it goes with a killed process; what such a process left behind is removed by the next writer.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import platformdirs

from outlap.errors import OutlapError

CACHE_VARIABLE = "OUTLAP_CACHE"
STAGING_PREFIX = ".staging-"


def cache_root() -> Path:
    """`$OUTLAP_CACHE`, or outlap's folder in the platform's user cache; may not exist."""
    return Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("outlap", appauthor=False)).expanduser()


def cache_folder() -> Path:
    """The folder of cached tracks, in `cache_root`; may not exist."""
    return cache_root() / "tracks"


@contextmanager
def staging(folder: Path, wait_s: float = 600.0) -> Iterator[Path]:
    """Hold the write lock of `folder` (made if need be) and give a fresh hidden folder inside it.

    The hidden folder is on the same file system, so that `install` is one rename, and is removed at the end.

    Raises:
        OutlapError: the folder cannot be written, or another process held the lock for all of `wait_s` [s].
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("a+b")
    except OSError as error:
        raise OutlapError(
            f"{folder}: cannot write here ({error.strerror}); set {CACHE_VARIABLE} to a folder that you can write to"
        ) from error
    with lock:
        _wait_for(lock, folder, wait_s)
        for leftover in folder.glob(f"{STAGING_PREFIX}*"):
            shutil.rmtree(leftover, ignore_errors=True)
        prepared = Path(tempfile.mkdtemp(prefix=STAGING_PREFIX, dir=folder))
        try:
            yield prepared
        finally:
            shutil.rmtree(prepared, ignore_errors=True)


def install(prepared: Path, target: Path) -> Path:
    """Rename the folder `prepared`, which lies in a staging folder, to `target`, replacing what is there."""
    prepared.chmod(0o755)
    if not target.exists():
        return prepared.rename(target)
    replaced = prepared.with_name("replaced")  # goes away with the staging folder
    target.rename(replaced)
    try:
        return prepared.rename(target)
    except OSError:
        replaced.rename(target)
        raise


def _wait_for(lock: IO[bytes], folder: Path, wait_s: float) -> None:
    give_up = time.monotonic() + wait_s
    while not _try_lock(lock):
        if time.monotonic() >= give_up:
            raise OutlapError(
                f"{folder}: another process has been writing here for more than {wait_s:.0f} s; wait for it, or end it"
            )
        time.sleep(0.1)


if sys.platform == "win32":
    import msvcrt

    def _try_lock(lock: IO[bytes]) -> bool:
        lock.seek(0)
        with suppress(OSError):
            msvcrt.locking(lock.fileno(), msvcrt.LK_NBLCK, 1)
            return True
        return False
else:
    import fcntl

    def _try_lock(lock: IO[bytes]) -> bool:
        with suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        return False
