"""Frame: what can be seen of a race at a moment, for everything that draws or records it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from outlap.config import Config
from outlap.envs.race import EGO
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.simulator import state as column
from outlap.simulator.collision import REMOVED
from outlap.simulator.lidar import beam_angles

MOTION = (column.X, column.Y, column.YAW, column.SPEED, column.STEER, column.SLIP)  # columns of `Frame.motion`
X, Y, YAW, SPEED, STEER, SLIP = range(len(MOTION))
NO_ECHO = 0.99  # of the largest range: noise aside, a beam that is longer hit nothing


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError(f"{text!r} holds characters that cannot be shown")
    return text


Words = Annotated[str, AfterValidator(_printable)]


class Cast(Config):
    """Who races: what stays as it is during an episode. Car 0 is the ego."""

    drivers: tuple[Words, ...]
    sizes: tuple[tuple[float, float], ...]  # length and width of every car [m]
    field_of_view: float  # of the ego's scanner [rad]
    max_range: float  # of it [m]: a beam that hits nothing is as long
    mount_x: float  # of it in front of the centre of gravity [m]
    mu: float  # friction between the ego's tyres and the track

    def beam_ends(self, frame: Frame) -> np.ndarray:
        """Where the ego's beams hit something: (n, 2) [m], those that hit nothing left out."""
        scan = frame.scan.astype(float)
        x, y, yaw = frame.motion[EGO, [X, Y, YAW]]
        angles = yaw + beam_angles(len(scan), self.field_of_view)
        mount = (x + self.mount_x * np.cos(yaw), y + self.mount_x * np.sin(yaw))
        ends = np.column_stack([np.cos(angles), np.sin(angles)]) * scan[:, None] + mount
        return ends[scan < NO_ECHO * self.max_range]


@dataclass(frozen=True)
class Frame:
    """A moment of a race."""

    time: float  # since the start [s]
    motion: np.ndarray  # (cars, 6): x, y [m], yaw [rad], speed [m/s], steering angle, slip angle [rad]
    distance: np.ndarray  # (cars,) unwrapped arc length [m]: who is ahead of whom
    laps: np.ndarray  # (cars,) completed
    lap_time: np.ndarray  # (cars,) of the last one [s], NaN before
    contact: np.ndarray  # (cars,) of `simulator.collision`: FREE, HIT_WALL, HIT_CAR, REMOVED
    scan: np.ndarray  # (beams,) ranges of the ego [m]

    @property
    def places(self) -> np.ndarray:
        """Cars in the order of the race, the first one first: int (cars,); those off the track last."""
        return np.lexsort((-self.distance, self.contact == REMOVED))


def cast_of(env: RaceVectorEnv, driver: str) -> Cast:
    """Who races in the first world, with the name of the ego's driver; rivals of one name are numbered."""
    params = env.race.worlds.params[0]
    rivals = [name or f"car {car}" for car, name in enumerate(env.opponents.names()[0].tolist(), 1)]
    numbered = [
        name if rivals.count(name) == 1 else f"{name} {rivals[: i + 1].count(name)}" for i, name in enumerate(rivals)
    ]
    return Cast(
        drivers=(driver, *numbered),
        sizes=tuple((float(length), float(width)) for length, width in params[["length", "width"]]),
        field_of_view=env.config.field_of_view,
        max_range=float(params[EGO]["max_range"]),
        mount_x=float(params[EGO]["mount_x"]),
        mu=float(params[EGO]["mu"]),
    )


def frame_of(env: RaceVectorEnv) -> Frame:
    """What can be seen of the first world now: a copy."""
    worlds = env.race.worlds
    laps = worlds.laps[0].copy()
    return Frame(
        time=float(worlds.time[0]),
        motion=worlds.state[0][:, MOTION],
        distance=env.race.distance[0].copy(),
        laps=laps,
        lap_time=np.where(laps > 0, worlds.lap_time[0], np.nan),
        contact=worlds.contact[0].copy(),
        scan=worlds.scan[0, EGO].copy(),
    )


def between(before: Frame, after: Frame, share: float) -> Frame:
    """A frame between two: positions and angles in proportion, angles the short way; all else of the first.

    A car that was put somewhere else meanwhile stays where it was.
    """
    if share >= 1.0:
        return after
    seconds = after.time - before.time
    change = after.motion - before.motion
    change[:, YAW] = np.angle(np.exp(1j * change[:, YAW]))
    farthest = 0.5 + 2.0 * seconds * np.abs(np.stack([before.motion, after.motion])[..., SPEED]).max(axis=0)
    change[np.hypot(change[:, X], change[:, Y]) > farthest] = 0.0
    motion = before.motion + share * change
    time = before.time + share * seconds
    return Frame(time, motion, before.distance, before.laps, before.lap_time, before.contact, before.scan)
