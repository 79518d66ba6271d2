"""Recordings as one HTML file that needs nothing else: opens from disk, plays, and can be sent to a colleague."""

from __future__ import annotations

import base64
import io
import json
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from outlap.evaluation.frame import NO_ECHO, YAW
from outlap.evaluation.recording import Recording, check_together
from outlap.figure_style import COLOURS, WALL_GREY
from outlap.files import atomic_write
from outlap.simulator.lidar import beam_angles
from outlap.track.track import Track

MAX_MAP_PIXELS = 2400  # of the longer side
MAX_BEAMS = 180  # shown
SCANS_PER_SECOND = 12.5  # kept, at most
FRAMES_PER_SECOND = 50.0  # kept, at most
SCAN_STEP = 1e-3  # [m] that ranges are rounded to
LINE_SPACING = 0.5  # [m] between the points of a line


def write_replay(recordings: Sequence[Recording], track: Track, path: str | os.PathLike[str], title: str = "") -> Path:
    """Write recordings of races on one track to an HTML file.

    Raises OutlapError for recordings that cannot be shown together.
    """
    check_together(recordings, track, len(COLOURS))
    components = _principal_components([recording.context for recording in recordings])
    data = {
        "title": title or " and ".join(dict.fromkeys(recording.info.title for recording in recordings)),
        "track": _track(track),
        "terms": list(dict.fromkeys(term for recording in recordings for term in recording.info.terms)),
        "recordings": [
            _recording(recording, colour, context)
            for recording, colour, context in zip(recordings, COLOURS, components, strict=False)
        ],
    }
    # In JSON "<" can only be inside a text: escaped, no name can end the element that it stands in.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    template = resources.files("outlap.viewer").joinpath("replay.html").read_text(encoding="utf-8")
    return atomic_write(path, template.replace("__DATA__", text))


def _recording(recording: Recording, colour: str, context: np.ndarray | None) -> dict[str, Any]:
    info = recording.info
    every = _every(recording.time, FRAMES_PER_SECOND)
    frames = _kept(len(recording.time), every)
    scan_every = _every(recording.time[frames], SCANS_PER_SECOND)
    beams = recording.scan.shape[1]
    chosen = np.unique(np.rint(np.linspace(0, beams - 1, min(beams, MAX_BEAMS))).astype(int)) if beams else []
    motion = recording.motion[frames].copy()
    motion[..., YAW] = np.angle(np.exp(1j * motion[..., YAW]))
    scan = np.minimum(recording.scan[frames].astype(np.float32), info.cast.max_range)
    # Of every kept frame all that came since the one before: what lies between them is not lost.
    begins = np.concatenate([[0], frames[:-1] + 1])
    rewards = np.add.reduceat(recording.rewards, begins, axis=0) if info.terms else recording.rewards[frames]
    return {
        "title": info.title,
        "colour": colour,
        "outcome": info.outcome,
        **info.cast.model_dump(mode="json"),
        "contact": recording.contact[frames].tolist(),
        "events": [event.model_dump() for event in info.events],
        "terms": list(info.terms),
        "time": _packed(recording.time[frames], 1e-3),
        "motion": _packed(motion),
        "action": _packed(recording.action[frames]),
        "rewards": _packed(rewards),
        "scan": _packed(scan[::scan_every][:, chosen].reshape(-1, 1), SCAN_STEP),
        "scan_every": scan_every,
        "angles": np.round(beam_angles(beams, info.cast.field_of_view)[chosen], 5).tolist(),
        "nothing": NO_ECHO * info.cast.max_range,
        "context": None if context is None else _packed(context[frames]),
    }


def _every(time: np.ndarray, most: float) -> int:
    """Of how many frames one is kept, such that there are at most so many a second."""
    if len(time) < 2 or time[-1] <= time[0]:
        return 1
    return max(1, int(np.ceil((len(time) - 1) / float(time[-1] - time[0]) / most - 1e-6)))


def _kept(frames: int, every: int) -> np.ndarray:
    """The numbers of the frames that are kept, the last one among them."""
    kept = np.arange(0, frames, every)
    return kept if kept[-1] == frames - 1 else np.append(kept, frames - 1)


def _packed(values: np.ndarray, least: float = 0.0) -> dict[str, Any]:
    """Numbers in 16 bits, every column of the last axis in steps of its own: its range in 65,534, or `least`."""
    values = np.asarray(values, np.float64)
    columns = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
    low, high = (columns.min(axis=0), columns.max(axis=0)) if columns.size else np.zeros((2, columns.shape[1]))
    factor = np.maximum((high - low) / 65534.0, least)
    factor = np.where(factor > 0.0, factor, np.where(low != 0.0, np.abs(low), 1.0))  # constant
    shift = np.rint(low / factor)  # whole, so that 0 stays 0
    raw = np.clip(np.rint(columns / factor) - shift, 0, 65535).astype("<u2")
    data = base64.b64encode(raw.tobytes()).decode()
    return {"shift": shift.tolist(), "factor": factor.tolist(), "shape": list(values.shape), "data": data}


def _principal_components(contexts: Sequence[np.ndarray]) -> list[np.ndarray | None]:
    """The first two principal components of contexts, of all recordings together: (frames, 2) each."""
    known = [context for context in contexts if context.size]
    if not known or len({context.shape[1] for context in known}) > 1:
        return [None] * len(contexts)
    everything = np.concatenate(known).astype(np.float64)
    mean = everything.mean(axis=0)
    _, _, axes = np.linalg.svd(everything - mean, full_matrices=False)
    return [(context - mean) @ axes[:2].T if context.size else None for context in contexts]


def _track(track: Track) -> dict[str, Any]:
    block = -(-max(track.occupancy.shape) // MAX_MAP_PIXELS)
    coarse = track.coarse(block)
    pixels = np.flipud(coarse).astype(np.uint8)  # an image begins at the top
    image = Image.fromarray(pixels)
    image.putpalette([255, 255, 255, *bytes.fromhex(WALL_GREY[1:])])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True, bits=1, transparency=0)
    size = block * track.resolution
    points = track.centerline.position(np.arange(0.0, track.centerline.length, LINE_SPACING))
    margin = 1.0 + float(max(track.centerline.width_left.max(), track.centerline.width_right.max()))
    line = track.raceline
    return {
        "name": track.name,
        "walls": "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(),
        "origin": [float(value) for value in track.origin],
        "size": [image.width * size, image.height * size],
        "low": (points.min(axis=0) - margin).tolist(),
        "high": (points.max(axis=0) + margin).tolist(),
        "centreline": np.round(points, 2).tolist(),
        "raceline": None if line is None else np.round(np.column_stack([line.x, line.y]), 2).tolist(),
    }
