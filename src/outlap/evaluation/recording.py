"""A recorded episode: its frames, events and file format."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from outlap.config import Config, validate
from outlap.envs.race import EGO
from outlap.errors import OutlapError, brief
from outlap.evaluation.frame import MOTION, Cast, Frame, Words, X, Y, between
from outlap.files import atomic_write
from outlap.track.track import Track

SUFFIX = ".npz"
RECORDINGS = "recordings"  # folder of them in that of an evaluation
LARGEST_FILE = 512 * 2**20  # bytes, unpacked, that a recording may have


class Event(Config):
    """Something that happened in an episode."""

    time_s: float
    car: int  # number; 0 is the ego
    kind: Literal["start", "overtake", "place lost", "lap", "contact", "end"]
    text: Words


class RecordingInfo(Config):
    """What a recording says in words."""

    title: Words
    track: Words
    track_fingerprint: str
    seed: int
    cast: Cast
    outcome: Words
    events: tuple[Event, ...]
    terms: tuple[str, ...]  # of the reward


@dataclass(frozen=True)
class Recording:
    """An episode, frame by frame; a frame is an action of the ego. Frame 0 is the start."""

    info: RecordingInfo
    time: np.ndarray  # float32 (frames,) [s]
    motion: np.ndarray  # float32 (frames, cars, 6), see `Frame`
    distance: np.ndarray  # float32 (frames, cars)
    laps: np.ndarray  # int16 (frames, cars)
    lap_time: np.ndarray  # float32 (frames, cars)
    contact: np.ndarray  # uint8 (frames, cars)
    scan: np.ndarray  # float16 (frames, beams)
    action: np.ndarray  # float32 (frames, 2) of the ego: steer, speed; what led to the frame, 0 in the first
    rewards: np.ndarray  # float32 (frames, terms), weighted
    context: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))  # (frames, hidden), or empty

    @property
    def seconds(self) -> float:
        """From its first frame to its last one."""
        return float(self.time[-1] - self.time[0])

    def frame(self, number: int) -> Frame:
        """A frame of it."""
        values = {name: getattr(self, name)[number] for name in STORED}
        return Frame(**{**values, "time": float(values["time"]), "motion": values["motion"].astype(float)})

    def at(self, time: float) -> Frame:
        """What was to be seen at a time [s] since its start, between two frames as well."""
        now = min(max(time, 0.0), self.seconds) + float(self.time[0])
        number = min(int(np.searchsorted(self.time, now, side="right")) - 1, len(self.time) - 2)
        if number < 0:
            return self.frame(0)
        before, after = self.frame(number), self.frame(number + 1)
        return between(before, after, (now - before.time) / (after.time - before.time))

    @cached_property
    def path(self) -> np.ndarray:
        """Of the ego: (frames, 2) [m]."""
        return self.motion[:, EGO, [X, Y]]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write it as a NumPy archive that holds no code."""
        buffer = io.BytesIO()
        arrays = {name: getattr(self, name) for name in ARRAYS}
        words = np.frombuffer(self.info.model_dump_json().encode(), np.uint8)
        np.savez_compressed(buffer, info=words, **arrays)
        return atomic_write(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Read what `save` wrote; runs no code. Raises OutlapError for a file that is missing or broken."""
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as archive:
                if sum(member.file_size for member in archive.zip.infolist()) > LARGEST_FILE:  # type: ignore[union-attr]
                    raise ValueError("it is too large")
                words = archive["info"].tobytes()
                arrays = {name: archive[name].astype(TYPES[name]) for name in ARRAYS}
            info = validate(RecordingInfo, json.loads(words), str(path))
        except FileNotFoundError:
            raise OutlapError(f"{path}: no such file; record episodes with outlap evaluate --record") from None
        except OutlapError:
            raise
        except Exception as error:  # whatever a broken archive raises
            raise OutlapError(f"{path}: is no recording: {brief(error)}") from None
        frames, cars = len(arrays["time"]), len(info.cast.drivers)
        shapes = {
            "time": (frames,), "motion": (frames, cars, len(MOTION)), "distance": (frames, cars),
            "laps": (frames, cars), "lap_time": (frames, cars), "contact": (frames, cars), "action": (frames, 2),
            "rewards": (frames, len(info.terms)),
        }  # fmt: skip
        if not frames or not cars or cars != len(info.cast.sizes) or min(map(min, info.cast.sizes)) <= 0.0:
            raise OutlapError(f"{path}: has {frames} frames, {cars} drivers and cars of {info.cast.sizes} m")
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise OutlapError(f"{path}: {name} has shape {arrays[name].shape}; must be {shape}")
        for name, lengths in (("scan", (frames,)), ("context", (0, frames))):
            if arrays[name].ndim != 2 or len(arrays[name]) not in lengths:
                raise OutlapError(f"{path}: {name} has shape {arrays[name].shape}; must be ({frames}, any)")
        for name in ARRAYS:
            if name != "lap_time" and not np.isfinite(arrays[name]).all():
                raise OutlapError(f"{path}: {name} holds numbers that are not finite")
        if (np.diff(arrays["time"]) <= 0.0).any():
            raise OutlapError(f"{path}: time does not grow from frame to frame")
        return cls(info, **arrays)


# Of a frame, as they are stored; then what a recording has beside them.
STORED = {"time": "f4", "motion": "f4", "distance": "f4", "laps": "i2", "lap_time": "f4", "contact": "u1", "scan": "f2"}
TYPES = {**STORED, "action": "f4", "rewards": "f4", "context": "f4"}
ARRAYS = tuple(TYPES)


def check_together(recordings: Sequence[Recording], track: Track, most: int) -> None:
    """Raises OutlapError for no recording, too many to tell apart, or one of another track."""
    if not 1 <= len(recordings) <= most:
        raise OutlapError(f"{len(recordings)} recordings; 1 to {most} can be shown together")
    for recording in recordings:
        if recording.info.track_fingerprint != track.fingerprint:
            raise OutlapError(
                f"{recording.info.title}: was raced on {recording.info.track}, and {track.name} is another track, or "
                "another version of it; show races on one track together"
            )
