"""Small tracks whose geometry is known in closed form, and simulators with cars put on them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from outlap.simulator.simulator import Simulator, SimulatorConfig
from outlap.simulator.state import YAW, X, Y
from outlap.simulator.vehicle import (
    N_PARAMS,
    VehicleParams,
    accepted_bounds,
    parameter_bounds,
    to_records,
    to_values,
)
from outlap.simulator.worlds import Worlds
from outlap.track.centerline import Centerline
from outlap.track.track import Track

CAR = to_records(parameter_bounds(VehicleParams())[0])  # the parameters of the F1TENTH car


def circle(x: float, y: float, radius: float, half_width: float = 1.0) -> Centerline:
    """A circle, driven anticlockwise from its rightmost point."""
    angle = np.linspace(0.0, 2.0 * math.pi, 256, endpoint=False)
    points = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    return Centerline.from_points(points, half_width, half_width)


def wavy(count: int = 240) -> Centerline:
    """A closed line with bends of both signs, radius down to about 2 m."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    radius = 20.0 + 3.0 * np.sin(5.0 * angle) + 1.0 * np.cos(3.0 * angle)
    return Centerline.from_points(
        np.column_stack([radius * np.cos(angle) + 7.0, radius * np.sin(angle) - 4.0]), 1.0, 1.2
    )


def circular(difference: np.ndarray, length: float) -> np.ndarray:
    """A difference of arc lengths on a closed line, in [-length / 2, length / 2)."""
    return (difference + 0.5 * length) % length - 0.5 * length


def ring(radius: float = 8.0, half_width: float = 1.2, resolution: float = 0.05, yaw: float = 0.0) -> Track:
    """A circular track about the map frame's origin, on a grid turned by `yaw`."""
    half = radius + half_width + 0.5
    count = math.ceil(2.0 * half / resolution)
    centres = (np.arange(count) + 0.5) * resolution - half
    distance = np.hypot(*np.meshgrid(centres, centres))
    occupancy = np.abs(distance - radius) > half_width
    corner = -half * (math.cos(yaw) - math.sin(yaw)), -half * (math.sin(yaw) + math.cos(yaw))
    line = circle(0.0, 0.0, radius, half_width)
    return Track(f"ring{radius:g}", occupancy, resolution, (*corner, yaw), line)


def hall(occupancy: np.ndarray, resolution=0.05, origin=(0.0, 0.0, 0.0), radius=5.0) -> Track:
    """Any map. Its centreline is a circle about the middle, from which `starts_at` can reach every pose."""
    height, width = occupancy.shape
    u, v = 0.5 * width * resolution, 0.5 * height * resolution
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    middle = origin[0] + cos * u - sin * v, origin[1] + sin * u + cos * v
    return Track("hall", occupancy, resolution, origin, circle(*middle, radius))


def yard(side: float = 40.0) -> Track:
    """An empty square hall about the map frame's origin."""
    cells = round(side / 0.1)
    return hall(np.zeros((cells, cells), bool), 0.1, (-0.5 * side, -0.5 * side, 0.0))


def random_map(rng: np.random.Generator, height: int, width: int, share: float) -> np.ndarray:
    """Single wall cells, bars one cell thick, and stairs of cells that touch at their corners only."""
    occupancy = rng.random((height, width)) < share
    for _ in range(3):
        row, col, length = rng.integers(height), rng.integers(width), int(rng.integers(5, 20))
        occupancy[row, col : col + length] = True
        row, col, length = rng.integers(height), rng.integers(width), int(rng.integers(5, 20))
        occupancy[row : row + length, col] = True
        row, col, length = rng.integers(height), rng.integers(width), np.arange(rng.integers(5, 20))
        rows, cols = row + length, col + rng.choice([-1, 1]) * length
        inside = (rows < height) & (cols >= 0) & (cols < width)
        occupancy[rows[inside], cols[inside]] = True
    return occupancy


def starts_at(track: Track, x: ArrayLike, y: ArrayLike, yaw: ArrayLike, speed: ArrayLike) -> np.ndarray:
    """Rows for `Simulator.reset` that put cars at poses of the map frame: (..., 4)."""
    s, d = track.centerline.to_frenet(x, y)
    error = np.asarray(yaw) - track.centerline.heading(s)
    return np.stack(np.broadcast_arrays(s, d, error, speed), axis=-1)


def place(
    tracks: Track | list[Track],
    poses: ArrayLike,
    *,
    speed: ArrayLike = 0.0,
    params: np.ndarray = CAR,
    which_track: ArrayLike | None = None,
    keys: ArrayLike | None = None,
    **config: Any,
) -> Simulator:
    """A simulator with cars at poses of the map frame.

    Args:
        tracks: one track, or several of which `which_track` (worlds,) says which.
        poses: (worlds, cars, 3) x [m], y [m], yaw [rad].
        speed, params: broadcast to (worlds, cars) and (worlds, cars).
        keys: (worlds,) of the sensor noise.
        config: of `SimulatorConfig`.
    """
    tracks = tracks if isinstance(tracks, list) else [tracks]
    poses = np.asarray(poses, np.float64)
    worlds, cars, _ = poses.shape
    which_track = np.zeros(worlds, int) if which_track is None else np.asarray(which_track)
    x, y, yaw = np.moveaxis(poses, -1, 0)
    speed = np.broadcast_to(speed, (worlds, cars))
    starts = np.stack([starts_at(tracks[which_track[w]], x[w], y[w], yaw[w], speed[w]) for w in range(worlds)])
    sim = Simulator(tracks, worlds, cars, SimulatorConfig(**config))
    sim.reset(
        np.arange(worlds),
        keys=np.arange(worlds, dtype=np.uint64) if keys is None else np.asarray(keys, np.uint64),
        tracks=which_track,
        params=np.broadcast_to(params, (worlds, cars)),
        starts=starts,
    )
    off = sim.worlds.state[..., [X, Y, YAW]] - poses
    off[..., 2] -= 2.0 * math.pi * np.round(off[..., 2] / (2.0 * math.pi))
    assert np.abs(off).max() < 1e-4, "a pose was not reached"
    return sim


def random_cars(rng: np.random.Generator, worlds: int, cars: int) -> np.ndarray:
    """Parameters within 30 % of the F1TENTH car's."""
    values = to_values(CAR) * rng.uniform(0.7, 1.3, (worlds, cars, N_PARAMS))
    return to_records(np.clip(values, *accepted_bounds()))


def random_commands(rng: np.random.Generator, params: np.ndarray) -> np.ndarray:
    """At or near the limits of each car, both ways, or nothing: (worlds, cars, 2)."""
    choice = rng.integers(0, 3, params.shape)
    steer = np.choose(choice, [params["steer_min"], params["steer_max"], 0.0 * choice])
    choice = rng.integers(0, 4, params.shape)
    speed = np.choose(choice, [params["v_min"], params["v_max"], 0.0 * choice, 0.4 * params["v_max"]])
    return np.stack([steer, speed], axis=-1)


def snapshot(sim: Simulator, world: Any = slice(None)) -> dict[str, np.ndarray]:
    """Copies of all that is known of some worlds."""
    return {name: getattr(sim.worlds, name)[world].copy() for name in Worlds._fields}


def assert_same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Bit for bit."""
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)
