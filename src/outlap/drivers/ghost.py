"""A recorded lap as a driver."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from outlap.drivers.classical import WHEELBASE, speed_action
from outlap.drivers.driver import Driver
from outlap.errors import OutlapError, brief
from outlap.files import atomic_write

COLUMNS = ("t_s", "x_m", "y_m", "yaw_rad", "vx_mps")
SHORTEST = 8  # points of a lap
PREVIEW = 0.1  # [s] ahead from where curvature and speed are taken: what the car takes to follow a command
OFFSET_GAIN = 0.6  # [rad/m]
HEADING_GAIN = 1.2  # [-]
FARTHEST = 1.5  # [m] that an offset counts at most: from farther away it comes back at an angle of 45°


class _Path(NamedTuple):
    """What a lap's points lie on, beside each of them."""

    length: float  # [m] once around
    s: np.ndarray  # arc length [m]
    course: np.ndarray  # direction of travel [rad]
    yaw: np.ndarray  # [rad], without jumps
    curvature: np.ndarray  # change of yaw [rad/m]


@dataclass(frozen=True, eq=False)
class Ghost(Driver):
    """Drives a recorded lap again, and again: its path, at its yaw and its speed in every place.

    It steers the curvature of the path, corrected by offset and yaw, so back to the path wherever it is put, and gives
    way to nobody. It belongs on the track of the recording.
    """

    lap: np.ndarray  # float64 (n, 5), see COLUMNS; the car's middle, in the order driven, once around
    name: str = "ghost"
    observation_terms: tuple[str, ...] = ("pose", "vel", "action_span")

    def __post_init__(self) -> None:
        if self.lap.ndim != 2 or self.lap.shape[1] != len(COLUMNS) or len(self.lap) < SHORTEST:
            raise OutlapError(
                f"{self.name}: the lap has shape {self.lap.shape}; must be ({SHORTEST} or more, {len(COLUMNS)}): "
                f"{', '.join(COLUMNS)}"
            )
        if not np.isfinite(self.lap).all():
            row, column = np.argwhere(~np.isfinite(self.lap))[0]
            raise OutlapError(f"{self.name}: {COLUMNS[column]} of point {row} is {self.lap[row, column]}")
        if not np.ptp(self.lap[:, 1:3], axis=0).any():
            raise OutlapError(f"{self.name}: all points of the lap are in one place")

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        path, speeds = self._path, self.lap[:, 4]
        pose, span = observation["pose"].astype(np.float64), observation["action_span"]
        dx, dy = pose[:, :1] - self.lap[:, 1], pose[:, 1:2] - self.lap[:, 2]
        nearest = np.hypot(dx, dy).argmin(axis=1)
        each = np.arange(len(pose))
        dx, dy = dx[each, nearest], dy[each, nearest]
        cos, sin = np.cos(path.course[nearest]), np.sin(path.course[nearest])
        along, offset = cos * dx + sin * dy, cos * dy - sin * dx
        turned = _wrapped(pose[:, 2] - path.yaw[nearest] - path.curvature[nearest] * along)
        ahead = path.s[nearest] + along + PREVIEW * np.maximum(observation["vel"][:, 0], 0.0)
        curvature, speed = (np.interp(ahead, path.s, of, period=path.length) for of in (path.curvature, speeds))
        steer = np.arctan(WHEELBASE * curvature) - HEADING_GAIN * turned
        steer -= OFFSET_GAIN * np.clip(offset, -FARTHEST, FARTHEST)
        return np.stack([np.clip(steer / span[:, 0], -1.0, 1.0), speed_action(speed, span)], axis=1)

    @cached_property
    def _path(self) -> _Path:
        x, y, yaw = self.lap[:, 1], self.lap[:, 2], np.unwrap(self.lap[:, 3])
        steps = np.hypot(np.roll(x, -1) - x, np.roll(y, -1) - y)
        across_x, across_y, turn = (np.roll(of, -1) - np.roll(of, 1) for of in (x, y, yaw))
        return _Path(
            length=float(steps.sum()),
            s=np.cumsum(steps) - steps,
            course=np.arctan2(across_y, across_x),
            yaw=yaw,
            curvature=_wrapped(turn) / np.maximum(steps + np.roll(steps, 1), 1e-6),
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the lap as csv with a header."""
        rows = [",".join(COLUMNS), *(",".join(f"{value:.6g}" for value in row) for row in self.lap)]
        return atomic_write(path, "\n".join(rows) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Ghost:
        """Read what `save` wrote. Raises OutlapError for a file that is missing or no such csv."""
        try:
            header, *rows = Path(path).read_text(encoding="utf-8").splitlines()
            if tuple(header.split(",")) != COLUMNS:
                raise ValueError(f"its first line is {header[:60]!r}; must be {','.join(COLUMNS)!r}")
            lap = np.array([[float(value) for value in row.split(",")] for row in rows if row.strip()])
        except (OSError, ValueError) as error:
            raise OutlapError(f"{path}: cannot be read as a recorded lap: {brief(error)}") from None
        return cls(lap, name=Path(path).stem)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] within half a turn of 0."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))
