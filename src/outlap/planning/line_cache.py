"""Planned lines in a cache on disk, so that each is planned once on a machine."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from outlap.errors import brief
from outlap.files import atomic_write
from outlap.planning.limits import CarLimits
from outlap.planning.path import ClosedPath
from outlap.planning.plan import DEFAULT_MARGIN, Method, PlannedLine, plan_line
from outlap.track.cache import cache_root
from outlap.track.track import Track

VERSION = 1  # of the planner: grows with every change that moves a line

log = logging.getLogger(__name__)


def cached_line(
    track: Track, limits: CarLimits, method: Method = "min-time", margin: float = DEFAULT_MARGIN
) -> PlannedLine:
    """Return the line of `plan_line`, from the cache if the same walls, centreline, limits and margin are in it."""

    def plan() -> dict[str, np.ndarray]:
        log.info("%s: planning the %s line; it is kept for the next time", track.name, method)
        planned = plan_line(track, limits, method, margin)
        numbers = np.array([planned.lap_time, planned.min_margin, planned.solve_time])
        return {**path_arrays(planned.path), "speed": planned.speed, "numbers": numbers}

    saved = cached(["line", track.fingerprint, asdict(limits), method, margin], plan)
    return PlannedLine(path_of(saved), saved["speed"], method, limits, *saved["numbers"].tolist())


def cached(key: Any, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the arrays kept under `key`, plain data that determines them; else make and keep them.

    A cache that cannot be read or written, or holds half a file, costs time and nothing else.
    """
    digest = hashlib.sha256(json.dumps([VERSION, key], sort_keys=True).encode()).hexdigest()
    file = cache_root() / "planning" / f"{digest}.npz"
    try:
        with np.load(file) as saved:
            return dict(saved)
    except FileNotFoundError:
        pass
    except Exception as error:  # whatever a broken archive raises
        log.warning("%s: cannot be read (%s) and is made anew", file, brief(error))
    made = make()
    buffer = io.BytesIO()
    np.savez(buffer, **made)  # type: ignore[arg-type]
    try:
        atomic_write(file, buffer.getvalue())
    except OSError as error:
        log.warning("%s: cannot be kept (%s); set OUTLAP_CACHE to a folder that you can write to", file, error.strerror)
    return made


def path_arrays(path: ClosedPath, prefix: str = "") -> dict[str, np.ndarray]:
    """Return a path as arrays for `cached`."""
    columns = np.column_stack([path.points, path.heading, path.curvature])
    return {f"{prefix}path": columns, f"{prefix}length": np.array(path.length)}


def path_of(saved: Mapping[str, np.ndarray], prefix: str = "") -> ClosedPath:
    """Return the path that `path_arrays` was given."""
    columns = saved[f"{prefix}path"]
    points, heading, curvature = columns[:, :2].copy(), columns[:, 2].copy(), columns[:, 3].copy()
    return ClosedPath(points, heading, curvature, float(saved[f"{prefix}length"]))
