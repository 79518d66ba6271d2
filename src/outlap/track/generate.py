"""Random closed circuits from a seed, and the built-in named set."""

from __future__ import annotations

import functools
import math
import numbers
from dataclasses import asdict, dataclass

import numpy as np

from outlap.errors import OutlapError
from outlap.track.centerline import Centerline
from outlap.track.circuit import WALL, circuit_points
from outlap.track.track import Track
from outlap.track.walls import draw_walls

MARGIN = 1.0  # [m] of wall around the drivable band at the map's edge
BUILTIN_RESOLUTION = 0.0625  # [m/pixel] as fine as most published F1TENTH maps
LONGEST = 5000.0  # [m] circuit; beyond, the shortest tour through so many corners takes minutes


@dataclass(frozen=True)
class BuiltinCircuit:
    """The data of a built-in circuit: all of generate_track's arguments."""

    seed: int
    length: float  # [m]
    clockwise: bool
    width: float = 2.2  # [m]
    min_radius: float = 1.5  # [m]


# Chosen by eye from consecutive seeds, for variety alone: before any policy had driven them.
TRAINING_CIRCUITS: dict[str, BuiltinCircuit] = {
    "Alderbrook": BuiltinCircuit(seed=4, length=160.0, min_radius=1.2, clockwise=False),
    "Brackenfell": BuiltinCircuit(seed=10, length=230.0, clockwise=True),
    "Cinderhill": BuiltinCircuit(seed=23, length=230.0, width=2.0, clockwise=False),
    "Dunmarrow": BuiltinCircuit(seed=15, length=340.0, clockwise=True),
    "Emberley": BuiltinCircuit(seed=25, length=340.0, clockwise=True),
    "Foxglove": BuiltinCircuit(seed=0, length=340.0, clockwise=False),
    "Gorsewick": BuiltinCircuit(seed=27, length=440.0, clockwise=True),
    "Harrowmere": BuiltinCircuit(seed=7, length=440.0, width=2.4, clockwise=False),
    "Ironmill": BuiltinCircuit(seed=18, length=340.0, clockwise=True),
    "Kittiwake": BuiltinCircuit(seed=3, length=290.0, width=2.6, min_radius=6.0, clockwise=False),
}
HELD_OUT_CIRCUITS: dict[str, BuiltinCircuit] = {
    "Nightjar": BuiltinCircuit(seed=15, length=440.0, clockwise=True),
    "Oakhaven": BuiltinCircuit(seed=10, length=340.0, clockwise=False),
    "Quillmoor": BuiltinCircuit(seed=21, length=230.0, clockwise=True),
}
BUILTIN_TRAIN: tuple[str, ...] = tuple(TRAINING_CIRCUITS)
BUILTIN_HELD_OUT: tuple[str, ...] = tuple(HELD_OUT_CIRCUITS)


def generate_track(
    seed: int,
    length: float = 300.0,
    width: float = 2.2,
    min_radius: float = 1.5,
    name: str | None = None,
    clockwise: bool | None = None,
    resolution: float = 0.05,
) -> Track:
    """A random closed circuit; on one machine the same arguments give the same track, bit for bit.

    The start line is in the middle of the longest straight, at (0, 0).

    Args:
        seed: whole number, 0 or more.
        length: of the centreline [m].
        width: of the drivable band [m].
        min_radius: the centreline turns no tighter than this [m]; at least half the width.
        name: of the track; "generated-SEED" if None.
        clockwise: direction of driving; drawn from the seed if None.
        resolution: of the map [m/pixel].

    Raises:
        OutlapError: an argument is out of range, or no circuit fits the arguments.
    """
    _validate(seed, length, width, min_radius, resolution)
    points = circuit_points(seed, length, width, min_radius, clockwise)
    half_widths = np.full(len(points), width / 2)
    centerline = Centerline.from_points(points, half_widths, half_widths)
    occupancy, origin = draw_walls(centerline, resolution, MARGIN)
    return Track(f"generated-{seed}" if name is None else name, occupancy, resolution, origin, centerline)


@functools.cache
def builtin_track(name: str) -> Track:
    """A track of BUILTIN_TRAIN or BUILTIN_HELD_OUT, generated at the first call and kept in memory.

    Raises:
        OutlapError: no built-in track has this name.
    """
    circuit = (TRAINING_CIRCUITS | HELD_OUT_CIRCUITS).get(name)
    if circuit is None:
        known = ", ".join(BUILTIN_TRAIN + BUILTIN_HELD_OUT)
        raise OutlapError(f"built-in track: name is {name!r}; must be one of {known}")
    return generate_track(name=name, resolution=BUILTIN_RESOLUTION, **asdict(circuit))


def _validate(seed: int, length: float, width: float, min_radius: float, resolution: float) -> None:
    whole: object = seed
    if isinstance(whole, bool) or not isinstance(whole, numbers.Integral) or whole < 0:
        raise OutlapError(f"generate_track: seed is {seed!r}; must be a whole number, 0 or more")
    sizes: dict[str, object] = {"length": length, "width": width, "min_radius": min_radius, "resolution": resolution}
    for field, value in sizes.items():
        if not (isinstance(value, numbers.Real) and math.isfinite(value) and float(value) > 0):
            raise OutlapError(f"generate_track: {field} is {value!r}; must be a positive number of metres")
    if min_radius < width / 2:
        raise OutlapError(
            f"generate_track: min_radius is {min_radius}; must be at least half the width, {width / 2:.3g} m"
        )
    if resolution > width / 10:
        raise OutlapError(
            f"generate_track: resolution is {resolution}; must be at most a tenth of the width, {width / 10:.3g} m"
        )
    if length > LONGEST:
        raise OutlapError(f"generate_track: length is {length}; must be at most {LONGEST:.0f} m")
    shortest = 12 * max(min_radius, (width + WALL) / 2)
    if length < shortest:
        raise OutlapError(
            f"generate_track: length is {length}; must be at least {shortest:.1f} m"
            f" for min_radius {min_radius} and width {width}"
        )
