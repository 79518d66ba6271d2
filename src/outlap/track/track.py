"""A track: walls on a grid, the centreline, and a racing line where there is one."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from outlap.errors import OutlapError
from outlap.track.centerline import Centerline
from outlap.track.distance import wall_distance
from outlap.track.raceline import Raceline


@dataclass(frozen=True, eq=False)
class Track:
    """An immutable track.

    The grid's row 0 is the bottom row: y grows with the row index. `origin` is the lower-left corner
    of the pixel in row 0 and column 0, and the grid is turned about it by its yaw.
    """

    name: str
    occupancy: np.ndarray  # (height, width) bool, True = wall; read-only
    resolution: float  # [m/pixel]
    origin: tuple[float, float, float]  # x [m], y [m], yaw [rad]
    centerline: Centerline
    raceline: Raceline | None = None

    def __post_init__(self) -> None:
        occupancy = np.array(self.occupancy, dtype=bool, order="C")  # a copy: nobody else can write to it
        if occupancy.ndim != 2 or occupancy.size == 0:
            raise OutlapError(f"track {self.name}: occupancy has shape {occupancy.shape}; must be (height, width)")
        if not (math.isfinite(self.resolution) and self.resolution > 0.0):
            raise OutlapError(
                f"track {self.name}: resolution is {self.resolution}; it must be a positive number of metres per pixel"
            )
        if len(self.origin) != 3 or not all(map(math.isfinite, self.origin)):
            raise OutlapError(f"track {self.name}: origin is {self.origin}; it must be (x, y, yaw), all finite")
        occupancy.setflags(write=False)
        object.__setattr__(self, "occupancy", occupancy)
        object.__setattr__(self, "origin", tuple(map(float, self.origin)))

    def summary(self) -> dict[str, str | float | bool]:
        """Return length, tightest radius, widths [m] and direction of the centreline, and if there is a racing line."""
        line = self.centerline
        s = np.arange(0.0, line.length, 0.05)
        right, left = line.widths(s)
        curvature = line.curvature(s)
        return {
            "name": self.name,
            "length_m": round(line.length, 3),
            "min_radius_m": round(float(1.0 / np.max(np.abs(curvature))), 3),
            "mean_width_m": round(float(np.mean(right + left)), 3),
            "min_width_m": round(float(np.min(right + left)), 3),
            "clockwise": bool(np.sum(curvature) < 0.0),
            "raceline": self.raceline is not None,
        }

    def reversed(self) -> Track:
        """The same circuit driven the other way round; the racing line, made for this way, is left out."""
        line = self.centerline
        order = np.roll(np.arange(len(line.points))[::-1], 1)  # the start line stays where it is
        backwards = Centerline.from_points(line.points[order], line.width_left[order], line.width_right[order])
        return replace(self, name=f"{self.name} reversed", centerline=backwards, raceline=None)

    def mirrored(self) -> Track:
        """The circuit seen in a mirror, x → -x: every left turn becomes a right turn."""
        x, y, yaw = self.origin
        across = self.occupancy.shape[1] * self.resolution
        line, racing = self.centerline, self.raceline
        if racing is not None:
            racing = replace(racing, x=-racing.x, heading=np.pi - racing.heading, curvature=-racing.curvature)
        return Track(
            name=f"{self.name} mirrored",
            occupancy=self.occupancy[:, ::-1],
            resolution=self.resolution,
            # The corner that was lower right.
            origin=(-x - across * math.cos(yaw), y + across * math.sin(yaw), -yaw),
            centerline=Centerline.from_points(line.points * [-1.0, 1.0], line.width_left, line.width_right),
            raceline=racing,
        )

    def coarse(self, block: int) -> np.ndarray:
        """The walls in blocks of `block` × `block` pixels: bool, True where any of them is wall.

        Row 0 and column 0 begin where the grid does; the last ones may reach beyond it.
        """
        rows, cols = self.occupancy.shape
        padded = np.pad(self.occupancy, [(0, -rows % block), (0, -cols % block)])
        blocks = padded.reshape(-(-rows // block), block, -(-cols // block), block)
        return np.asarray(blocks.any(axis=(1, 3)))

    @cached_property
    def distance_field(self) -> np.ndarray:
        """How far a ray can go from anywhere in a cell: (height, width) float32 [m].

        The exact distance from the cell's square to the nearest wall square: 0 for a cell that
        touches one, at a corner too, and -1 in a wall. What lies outside the grid is wall.
        """
        field = wall_distance(self.occupancy, self.resolution)
        field.setflags(write=False)
        return field

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of walls, their place and the centreline: what tells two versions of a map apart."""
        digest = hashlib.sha256(np.packbits(self.occupancy).tobytes())
        digest.update(np.array([*self.occupancy.shape, self.resolution, *self.origin], np.float64).tobytes())
        digest.update(self.centerline.table().tobytes())
        return digest.hexdigest()

    def world_to_grid(self, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Map frame [m] → (column, row) as floats; the floor of each is the pixel's index."""
        x = np.asarray(x, dtype=np.float64) - self.origin[0]
        y = np.asarray(y, dtype=np.float64) - self.origin[1]
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return (cos * x + sin * y) / self.resolution, (cos * y - sin * x) / self.resolution

    def is_wall(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Whether each point (map frame, [m]) lies in a wall; outside the map counts as wall."""
        col, row = self.world_to_grid(x, y)
        height, width = self.occupancy.shape
        inside = (col >= 0.0) & (col < width) & (row >= 0.0) & (row < height)
        col, row = np.where(inside, col, 0.0).astype(np.intp), np.where(inside, row, 0.0).astype(np.intp)
        return ~inside | self.occupancy[row, col]
