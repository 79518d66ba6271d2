"""Tasks: the track and the parameters of every car, drawn at each reset."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from outlap.errors import OutlapError
from outlap.simulator.seeding import PARAMETER_STREAM, TRACK_STREAM, uniform
from outlap.simulator.vehicle import (
    N_PARAMS,
    ActuatorParams,
    LidarParams,
    VehicleParams,
    parameter_bounds,
    to_records,
)
from outlap.track.track import Track


@dataclass(frozen=True, eq=False)
class TaskSet:
    """A distribution of tasks: tracks, each as likely as the others, × a range of every parameter."""

    tracks: tuple[Track, ...]
    vehicle: VehicleParams = field(default_factory=VehicleParams)
    actuators: ActuatorParams = field(default_factory=ActuatorParams)
    lidar: LidarParams = field(default_factory=LidarParams)

    def __post_init__(self) -> None:
        if not self.tracks:
            raise OutlapError("tracks: none given; at least one is needed")

    @property
    def max_delay(self) -> float:
        """The longest actuator delay that a task can have [s]."""
        high = to_records(self._bounds[1])
        return float(max(high["steer_delay"], high["speed_delay"]))

    @cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return parameter_bounds(self.vehicle, self.actuators, self.lidar)

    def draw(self, keys: np.ndarray, episodes: np.ndarray, num_cars: int) -> tuple[np.ndarray, np.ndarray]:
        """The tasks of some worlds' next episodes; every car's parameters are drawn on their own.

        Args:
            keys: uint64 (n,) of the worlds, from `seeding.world_keys`.
            episodes: (n,) number of each world's episode.
            num_cars: cars a world.

        Returns:
            tracks: int64 (n,) positions in `tracks`.
            params: PARAMETERS (n, num_cars).
        """
        choice = uniform(keys, episodes, TRACK_STREAM, 1)[:, 0]
        low, high = self._bounds
        share = uniform(keys, episodes, PARAMETER_STREAM, num_cars * N_PARAMS)
        share = share.reshape(len(keys), num_cars, N_PARAMS)
        values = (low + share * (high - low)).astype(np.float32)
        return (choice * len(self.tracks)).astype(np.int64), to_records(np.clip(values, low, high))


@dataclass(frozen=True, eq=False)
class TaskSplit:
    """Training tasks and held-out tasks. Code that trains is handed `train` and nothing else."""

    train: TaskSet
    held_out: TaskSet

    def __post_init__(self) -> None:
        both = set(map(_circuit, self.train.tracks)) & set(map(_circuit, self.held_out.tracks))
        if both:
            raise OutlapError(f"tracks: {sorted(both)} are both trained on and held out; take them from one set")


def _circuit(track: Track) -> str:
    """The name of the circuit, whichever way it is driven or seen."""
    return track.name.removesuffix(" mirrored").removesuffix(" reversed")
