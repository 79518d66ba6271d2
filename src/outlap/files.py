"""Writing files so that a kill at any moment leaves the old one or the new one, never half of one."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pydantic_core

from outlap.errors import OutlapError


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path beside `path` to write to, renamed into place once the block is done; parent folders are made.

    A reader sees the old content or the new one. If the block fails, nothing is left of it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def make_folder(folder: Path) -> Path:
    """Make a folder, before the work that is to fill it. Raises OutlapError where it cannot be written to."""
    reason = "no permission"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    except OSError as error:
        reason = error.strerror or str(error)
    raise OutlapError(f"{folder}: cannot be written: {reason}; give another --out")


def remove_partials(folder: Path) -> None:
    """Remove the partial files of killed writers in a folder and those below it; keep those of running writers."""
    for path in folder.rglob(".*.partial*"):
        found = re.search(r"\.(\d+)\.partial", path.name)
        if found and not _is_running(int(found[1])):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if process != os.getpid() and os.name != "nt":  # on Windows, os.kill would end it
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        except OSError:  # another user's
            return True
    return True


def atomic_write(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write `content` to `path`, see `replacing`; returns the path."""
    with replacing(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return Path(path)


def to_json(data: Any) -> str:
    """Return `data` as indented JSON: NaN and infinity as null, arrays as lists, paths as strings.

    Raises TypeError for an object that is not plain data, an array, a dataclass or a Config.
    """
    try:
        plain = pydantic_core.to_json(data, inf_nan_mode="null", fallback=_array_as_list)
    except pydantic_core.PydanticSerializationError as error:
        raise TypeError(str(error)) from None
    return json.dumps(json.loads(plain), indent=2, ensure_ascii=False)


def _array_as_list(value: Any) -> Any:
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy for those who have none
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no form in JSON")
