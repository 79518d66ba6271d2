"""The folder that an evaluation leaves behind."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from outlap.errors import OutlapError
from outlap.files import atomic_write, make_folder, to_json

ROWS, UPDATES, SUMMARY, RECORD = "episodes.parquet", "updates.parquet", "summary.json", "evaluation.json"


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
