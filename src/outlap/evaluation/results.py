"""The folder that an evaluation leaves behind."""

from __future__ import annotations

import io
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock, Timeout

from outlap.errors import OutlapError
from outlap.files import atomic_write, make_folder, remove_partials, to_json

ROWS, UPDATES, SUMMARY, RECORD = "episodes.parquet", "updates.parquet", "summary.json", "evaluation.json"
LOCK = ".lock"


def prepare_folder(folder: Path) -> None:
    """Make the folder now, so that a long evaluation does not end in a failed write.

    Raises OutlapError where there is something in it already, or nothing can be written.
    """
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise OutlapError(f"{folder}: is there already; must be an empty or a new folder")
    make_folder(folder)


def save_results(folder: Path, rows: pd.DataFrame, summary: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Write an evaluation into its folder; a kill leaves no half of a file.

    Args:
        folder: made by `prepare_folder`.
        rows: of `evaluate`, as Parquet; `pandas.read_parquet` reads them back.
        summary: of `summarise`, as JSON.
        record: what is needed to repeat it, as JSON.
    """
    write_rows(rows, folder / ROWS)
    for name, content in ((SUMMARY, summary), (RECORD, record)):
        atomic_write(folder / name, to_json(content) + "\n")


def write_rows(rows: pd.DataFrame, path: Path) -> None:
    """Write rows as Parquet, beside their place and renamed."""
    buffer = io.BytesIO()
    rows.to_parquet(buffer, index=False)
    atomic_write(path, buffer.getvalue())


class Parts:
    """Results that come one after another, each kept when it is there: after a kill only what is missing is done."""

    def __init__(self, folder: Path, asked: Mapping[str, Any]) -> None:
        """Begin in a new folder, or go on in one where the same was begun.

        Args:
            folder: of the evaluation.
            asked: all that the results depend on.

        Raises OutlapError where something else is in the folder, another process is at work there, or nothing can be
        written.
        """
        self.folder = folder / "parts"
        self._asked = self.folder / "asked.json"
        if not self._asked.is_file() and not self._was_killed_at_once():
            prepare_folder(folder)
        make_folder(self.folder)
        self._lock = FileLock(self.folder / LOCK)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise OutlapError(
                f"{folder}: another process is at work there; wait for it, or give another --out"
            ) from None
        content = to_json(asked) + "\n"
        if self._asked.is_file() and self._asked.read_text(encoding="utf-8") != content:
            self._lock.release()
            raise OutlapError(
                f"{folder}: was begun with other settings, tracks, policy or versions ({self._asked}); give those, or "
                "another --out"
            )
        remove_partials(folder)
        atomic_write(self._asked, content)

    def has(self, number: int) -> bool:
        """Whether a part is done."""
        return self._path(number, ROWS).is_file()

    def put(self, number: int, rows: pd.DataFrame, updates: pd.DataFrame | None) -> None:
        """Keep a part: rows of episodes, and of the updates before them if there were any."""
        if updates is not None:
            write_rows(updates, self._path(number, UPDATES))
        write_rows(rows, self._path(number, ROWS))

    def rows(self, number: int) -> pd.DataFrame:
        """Rows of episodes of a part."""
        return pd.read_parquet(self._path(number, ROWS))

    def all_rows(self) -> pd.DataFrame:
        """Rows of episodes of all parts, in their order."""
        return self._all(ROWS)

    def all_updates(self) -> pd.DataFrame:
        """Rows of updates of all parts, in their order."""
        return self._all(UPDATES)

    def close(self) -> None:
        """Let another process go on."""
        self._lock.release()

    def remove(self) -> None:
        """Remove all parts, and close: the whole is written, or there is none."""
        self._asked.unlink(missing_ok=True)  # first: what is left after that is nobody's
        shutil.rmtree(self.folder, ignore_errors=True)
        self.close()

    def _path(self, number: int, name: str) -> Path:
        return self.folder / f"{number:06d}-{name}"

    def _all(self, name: str) -> pd.DataFrame:
        return pd.concat([pd.read_parquet(path) for path in sorted(self.folder.glob(f"*-{name}"))], ignore_index=True)

    def _was_killed_at_once(self) -> bool:
        """Whether there is only what a process leaves that had not noted yet what was asked."""
        if not self.folder.is_dir() or list(self.folder.parent.iterdir()) != [self.folder]:
            return False
        return all(path.name == LOCK or ".partial" in path.name for path in self.folder.iterdir())
