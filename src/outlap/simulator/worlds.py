"""The data of the batched step: what all worlds share, and the state of every world."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from outlap.simulator.state import N_STATE
from outlap.simulator.vehicle import PARAMETERS

# Columns of Worlds.frenet
ARC_LENGTH, OFFSET, HEADING_ERROR = range(3)
# Columns of Worlds.measured
FORWARD, LEFTWARD, YAW_RATE, STEER, SLIP = range(5)
# Constants.command: what the second command of a car is
SPEED, ACCELERATION = range(2)
# Constants.odometry: how a car measures its motion
FULL, VESC = range(2)


class Constants(NamedTuple):
    """What all worlds of a simulator share."""

    model: int  # KINEMATIC, SINGLE_TRACK, DRIFT or NONLINEAR_SINGLE_TRACK
    integrator: int  # EULER or RK4
    timestep: float  # [s] of physics
    substeps: int  # integrator steps per physics step
    command: int  # SPEED or ACCELERATION
    odometry: int  # FULL or VESC
    beam_cos: np.ndarray  # float32, see `lidar.beam_directions`
    beam_sin: np.ndarray


class Worlds(NamedTuple):
    """The state of every world; leading axes (worlds, cars)."""

    key: np.ndarray  # uint64 (worlds,) of the random numbers of this episode
    track: np.ndarray  # int32 (worlds,) number in the atlas
    time: np.ndarray  # float64 (worlds,) since the reset [s]
    tick: np.ndarray  # int64 (worlds,) physics steps since the reset
    params: np.ndarray  # PARAMETERS (worlds, cars)
    state: np.ndarray  # float32 (worlds, cars, N_STATE)
    measured: np.ndarray  # float32 (worlds, cars, 5): FORWARD, LEFTWARD [m/s], YAW_RATE [rad/s], STEER, SLIP [rad]
    road: np.ndarray  # float32 (worlds, bins): friction of equal parts of the lap / mu; without bins 1 everywhere
    before: np.ndarray  # float32 (worlds, cars, 3): x, y, yaw one physics step ago
    poses: np.ndarray  # float32 (worlds, cars, pose slots, 3): ring of the latest x, y, yaw, for late scans
    delayed: np.ndarray  # float32 (worlds, cars, slots, 2): ring of the latest commands
    lagged: np.ndarray  # float32 (worlds, cars, 2): commands behind delay and lag
    frenet: np.ndarray  # float64 (worlds, cars, 3): ARC_LENGTH [m], OFFSET [m], HEADING_ERROR [rad]
    distance: np.ndarray  # float64 (worlds, cars): arc length driven from the start line, unwrapped [m]
    next_line: np.ndarray  # int64 (worlds, cars): number of the next crossing of the start line
    lap_start: np.ndarray  # float64 (worlds, cars): time of the last crossing [s]; NaN on the out-lap
    laps: np.ndarray  # int64 (worlds, cars): laps completed, from line to line
    lap_time: np.ndarray  # float64 (worlds, cars): of the last completed lap [s]; NaN before
    contact: np.ndarray  # uint8 (worlds, cars): FREE, HIT_WALL, HIT_CAR or REMOVED; only a free car drives
    impact_speed: np.ndarray  # float32 (worlds, cars): at the contact, relative to what was hit [m/s]
    scan: np.ndarray  # float32 (worlds, cars, beams) [m]


def allocate_worlds(worlds: int, cars: int, slots: int, beams: int, pose_slots: int = 1, road_bins: int = 0) -> Worlds:
    """Return the arrays of some worlds, all zeros.

    Args:
        worlds, cars: worlds, and cars in each.
        slots: physics steps for which commands are kept, this one included.
        beams: of a scan.
        pose_slots: physics steps for which poses are kept, this one included.
        road_bins: parts of the lap with a friction of their own.
    """
    each = (worlds, cars)
    return Worlds(
        key=np.zeros(worlds, np.uint64),
        track=np.zeros(worlds, np.int32),
        time=np.zeros(worlds),
        tick=np.zeros(worlds, np.int64),
        params=np.zeros(each, PARAMETERS),
        state=np.zeros((*each, N_STATE), np.float32),
        measured=np.zeros((*each, 5), np.float32),
        road=np.ones((worlds, road_bins), np.float32),
        before=np.zeros((*each, 3), np.float32),
        poses=np.zeros((*each, pose_slots, 3), np.float32),
        delayed=np.zeros((*each, slots, 2), np.float32),
        lagged=np.zeros((*each, 2), np.float32),
        frenet=np.zeros((*each, 3)),
        distance=np.zeros(each),
        next_line=np.zeros(each, np.int64),
        lap_start=np.zeros(each),
        laps=np.zeros(each, np.int64),
        lap_time=np.zeros(each),
        contact=np.zeros(each, np.uint8),
        impact_speed=np.zeros(each, np.float32),
        scan=np.zeros((*each, beams), np.float32),
    )
