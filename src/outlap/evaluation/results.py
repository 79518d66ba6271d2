"""Evaluate a driver into a folder: rows, summary, and the record of what made them."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from outlap.drivers.driver import Driver
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.hot_spots import hot_spots
from outlap.evaluation.metrics import summarise
from outlap.evaluation.rollout import EvaluationProgress, evaluate
from outlap.files import atomic_write, make_folder, to_json
from outlap.provenance import provenance
from outlap.track.track import Track

ROWS, UPDATES, SUMMARY, RECORD = "episodes.parquet", "updates.parquet", "summary.json", "evaluation.json"


def evaluate_into(
    folder: Path,
    driver: Driver,
    env: RaceConfig,
    tracks: Sequence[Track],
    *,
    episodes: int,
    seed: int,
    num_worlds: int,
    trained_on: Sequence[str] = (),
    facts: Mapping[str, Any] | None = None,
    on_progress: Callable[[EvaluationProgress], None] | None = None,
) -> dict[str, Any]:
    """Evaluate a driver, write rows, summary and record to a folder, and return the summary with its `hot_spots`.

    Args:
        folder: new or empty; removed again if the evaluation does not finish.
        driver: to evaluate.
        env: the task, see `protocol.standing_starts`.
        tracks: to evaluate on.
        episodes: on each track.
        seed, num_worlds, on_progress: see `rollout.evaluate`.
        trained_on: the names of those tracks that the driver was trained on; the results name them.
        facts: added to the record.

    Raises OutlapError for a folder that is not empty or cannot be written, and what `evaluate` raises.
    """
    prepare_folder(folder)
    begun = time.monotonic()
    try:
        rows = evaluate(driver, env, tracks, episodes, seed, num_worlds, on_progress)
    except BaseException:
        with suppress(OSError):
            folder.rmdir()  # it is empty
        raise
    lengths = {track.name: track.centerline.length for track in tracks}
    summary = {**summarise(rows), "hot_spots": hot_spots(rows, lengths), "trained_on": list(trained_on)}
    record = {
        **provenance(),
        "seconds": round(time.monotonic() - begun, 1),
        "driver": driver.name,
        "tracks": {track.name: track.fingerprint for track in tracks},
        "trained_on": list(trained_on),
        "episodes_per_track": episodes,
        "seed": seed,
        "worlds": num_worlds,
        **(facts or {}),
        "env": env.model_dump(mode="json"),
    }
    save_results(folder, rows, summary, record)
    return {**summary, "driver": driver.name, "folder": folder}


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
        summary: of `summarise`, with the hot spots, as JSON.
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
