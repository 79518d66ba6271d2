"""The user's track cache: one writer at a time, and a track is either wholly there or not at all.

A track is prepared in a hidden folder inside the cache and renamed into place. The lock is the operating
system's, so it goes with a killed process; what such a process left behind is removed by the next writer.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import platformdirs
from filelock import FileLock, Timeout

from outlap.errors import OutlapError

CACHE_VARIABLE = "OUTLAP_CACHE"
STAGING_PREFIX = ".staging-"


def cache_root() -> Path:
    """Return `$OUTLAP_CACHE`, or outlap's folder in the platform's user cache; it may not exist."""
    return Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("outlap", appauthor=False)).expanduser()


def cache_folder() -> Path:
    """Return the folder of cached tracks, in `cache_root`; it may not exist."""
    return cache_root() / "tracks"


@contextmanager
def staging(folder: Path, wait_s: float = 600.0) -> Generator[Path, None, None]:
    """Hold the write lock of `folder`, which is made if need be, and yield a new hidden folder inside it.

    The hidden folder is on the same file system, so that `install` is one rename, and is removed at the end.

    Raises:
        OutlapError: the folder cannot be written, or another process held the lock for all of `wait_s` [s].
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock", timeout=wait_s).acquire()
    except Timeout:
        raise OutlapError(
            f"{folder}: another process has been writing here for more than {wait_s:.0f} s; wait for it, or end it"
        ) from None
    except OSError as error:
        raise OutlapError(
            f"{folder}: cannot write here ({error.strerror}); set {CACHE_VARIABLE} to a folder that you can write to"
        ) from error
    with lock:
        for leftover in folder.glob(f"{STAGING_PREFIX}*"):
            shutil.rmtree(leftover, ignore_errors=True)
        with TemporaryDirectory(prefix=STAGING_PREFIX, dir=folder, ignore_cleanup_errors=True) as prepared:
            yield Path(prepared)


def install(prepared: Path, target: Path) -> Path:
    """Rename the folder `prepared`, which lies in a staging folder, to `target`, and replace what is there."""
    prepared.chmod(0o755)
    if not target.exists():
        return prepared.rename(target)
    replaced = target.rename(prepared.with_name("replaced"))  # removed with the staging folder
    try:
        return prepared.rename(target)
    except OSError:
        replaced.rename(target)
        raise
