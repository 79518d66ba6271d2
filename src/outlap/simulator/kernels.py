"""The batched step: one pass over worlds × cars, in parallel over worlds.

Each function takes the tracks (`Atlas`), the constants of a simulator (`Constants`) and the arrays of all
worlds (`Worlds`), which it changes in place. Nothing is allocated.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from outlap.simulator import state as column
from outlap.simulator.actuators import (
    acceleration,
    delay_steps,
    lag,
    limit_acceleration,
    limit_force,
    motor_force,
    ramp,
    steering_rate,
)
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING, Atlas
from outlap.simulator.collision import FREE, REMOVED, touches_wall
from outlap.simulator.contacts import collide
from outlap.simulator.dynamics import (
    KINEMATIC,
    NONLINEAR_SINGLE_TRACK,
    derive,
    integrate,
    kinematic_values,
    rolling_wheel_speeds,
    wrap_angle,
)
from outlap.simulator.elementary import cosine_wide
from outlap.simulator.frenet import frenet_point, frenet_project
from outlap.simulator.lidar import apply_sensor_noise, cast_car, cast_walls
from outlap.simulator.seeding import hash64
from outlap.simulator.sensors import measure
from outlap.simulator.worlds import ACCELERATION, ARC_LENGTH, HEADING_ERROR, OFFSET, Constants, Worlds


@njit(cache=True, error_model="numpy", forceinline=True)
def _push(constants, target, now, p):
    """The acceleration [m/s^2] that motor or brakes ask for, given the command that has arrived."""
    speed = now[column.SPEED]
    if constants.model == NONLINEAR_SINGLE_TRACK:
        speed *= cosine_wide(now[column.SLIP])  # the wheels'
        if constants.command != ACCELERATION:
            return motor_force(target, speed, p) / p.m
    elif constants.command != ACCELERATION:
        return acceleration(target, speed, p)
    if target < 0.0 and speed <= 0.0:  # brakes hold a car; only a speed command reverses it
        return 0.0
    if constants.model == NONLINEAR_SINGLE_TRACK:
        return limit_force(target * (p.motor_force if target > 0.0 else p.brake_force), speed, p) / p.m
    return limit_acceleration(target * p.a_max, speed, p)


@njit(cache=True, error_model="numpy", forceinline=True)
def _drive(atlas, constants, worlds, w, c, steer_command, speed_command):
    """One physics step of one car, walls aside."""
    p = worlds.params[w, c]
    state = worlds.state[w, c]
    dt = constants.timestep

    slots = worlds.delayed.shape[2]
    slot = worlds.tick[w] % slots
    worlds.delayed[w, c, slot, 0] = steer_command
    worlds.delayed[w, c, slot, 1] = speed_command
    steer_late, speed_late = delay_steps(p, dt)
    steer_target = worlds.delayed[w, c, (slot - min(steer_late, slots - 1)) % slots, 0]
    speed_target = worlds.delayed[w, c, (slot - min(speed_late, slots - 1)) % slots, 1]
    steer_target = lag(worlds.lagged[w, c, 0], steer_target, dt, p.steer_lag)
    speed_target = lag(worlds.lagged[w, c, 1], speed_target, dt, p.speed_lag)
    if constants.command != ACCELERATION:
        speed_target = ramp(worlds.lagged[w, c, 1], speed_target, dt, p)
    worlds.lagged[w, c, 0] = steer_target
    worlds.lagged[w, c, 1] = speed_target

    angle = p.steer_ratio * steer_target + p.steer_trim

    parts = worlds.road.shape[1]
    if parts > 0:
        track = worlds.track[w]
        length = atlas.index[track, ROWS] * atlas.frame[track, SPACING]
        p.road_friction = worlds.road[w, min(int(worlds.frenet[w, c, ARC_LENGTH] / length * parts), parts - 1)]

    worlds.before[w, c, 0] = state[column.X]
    worlds.before[w, c, 1] = state[column.Y]
    worlds.before[w, c, 2] = state[column.YAW]
    # float() would leave these float32 until the loop widens them: Numba would compile the dynamics for both.
    now = (
        np.float64(state[column.X]), np.float64(state[column.Y]), np.float64(state[column.STEER]),
        np.float64(state[column.SPEED]), np.float64(state[column.YAW]), np.float64(state[column.YAW_RATE]),
        np.float64(state[column.SLIP]), np.float64(state[column.WHEEL_SPEED_FRONT]),
        np.float64(state[column.WHEEL_SPEED_REAR]),
    )  # fmt: skip
    h = dt / constants.substeps
    for _ in range(constants.substeps):
        rate = steering_rate(angle, now[column.STEER], h, p)
        push = _push(constants, speed_target, now, p)
        now = integrate(constants.model, constants.integrator, now, rate, push, h, p)
    for k in range(len(now)):
        state[k] = now[k]


@njit(cache=True, error_model="numpy", forceinline=True)
def _locate(atlas, worlds, w, c):
    """Project a car on the centreline, from where it was; returns the line's length [m]."""
    track = worlds.track[w]
    rows, spacing = atlas.index[track, ROWS], atlas.frame[track, SPACING]
    state, frenet = worlds.state[w, c], worlds.frenet[w, c]
    s, d, heading = frenet_project(
        atlas.line, atlas.index[track, FIRST_ROW], rows, spacing,
        float(state[column.X]), float(state[column.Y]), frenet[ARC_LENGTH],
    )  # fmt: skip
    frenet[ARC_LENGTH] = s
    frenet[OFFSET] = d
    frenet[HEADING_ERROR] = wrap_angle(state[column.YAW] - heading)
    return rows * spacing


@njit(cache=True, error_model="numpy", forceinline=True)
def _progress(atlas, constants, worlds, w, c):
    """Advance a car's unwrapped distance and its lap clock."""
    s_before = worlds.frenet[w, c, ARC_LENGTH]
    length = _locate(atlas, worlds, w, c)
    advance = worlds.frenet[w, c, ARC_LENGTH] - s_before
    advance -= length * math.floor(advance / length + 0.5)
    before = worlds.distance[w, c]
    worlds.distance[w, c] = before + advance
    line = worlds.next_line[w, c] * length
    if worlds.distance[w, c] >= line and advance > 0.0:
        crossed = worlds.time[w] - constants.timestep * (worlds.distance[w, c] - line) / advance
        if not math.isnan(worlds.lap_start[w, c]):
            worlds.laps[w, c] += 1
            worlds.lap_time[w, c] = crossed - worlds.lap_start[w, c]
        worlds.lap_start[w, c] = crossed
        worlds.next_line[w, c] += 1


@njit(cache=True, error_model="numpy", forceinline=True)
def _pose(worlds, w, c, late):
    """The pose of a car some physics steps ago, as far back as poses are kept."""
    slots = worlds.poses.shape[2]
    if slots == 1:
        state = worlds.state[w, c]
        return float(state[column.X]), float(state[column.Y]), float(state[column.YAW])
    pose = worlds.poses[w, c, (worlds.tick[w] - min(late, slots - 1)) % slots]
    return float(pose[0]), float(pose[1]), float(pose[2])


@njit(cache=True, error_model="numpy", forceinline=True)
def _keep_pose(worlds, w, c):
    slots = worlds.poses.shape[2]
    if slots > 1:
        pose, state = worlds.poses[w, c, worlds.tick[w] % slots], worlds.state[w, c]
        pose[0], pose[1], pose[2] = state[column.X], state[column.Y], state[column.YAW]


@njit(cache=True, error_model="numpy", forceinline=True)
def _sense(atlas, constants, worlds, w, c):
    """What one car measures as the world stands: its motion and its scan."""
    measure(constants, worlds, w, c)
    scan = worlds.scan[w, c]
    if scan.shape[0] == 0:
        return
    p = worlds.params[w, c]
    late = int(p.latency / constants.timestep + 0.5)
    x, y, yaw = _pose(worlds, w, c, late)
    x += p.mount_x * math.cos(yaw) - p.mount_y * math.sin(yaw)
    y += p.mount_x * math.sin(yaw) + p.mount_y * math.cos(yaw)
    yaw += p.mount_yaw
    beam_cos, beam_sin, max_range = constants.beam_cos, constants.beam_sin, p.max_range
    cast_walls(atlas, worlds.track[w], x, y, yaw, beam_cos, beam_sin, max_range, scan)
    for other in range(worlds.state.shape[1]):
        if other == c or worlds.contact[w, other] == REMOVED:
            continue
        size = worlds.params[w, other]
        other_x, other_y, other_yaw = _pose(worlds, w, other, late)
        dx, dy = other_x - x, other_y - y
        reach = max_range + size.length
        if dx * dx + dy * dy < reach * reach:
            cast_car(
                x, y, yaw, beam_cos, beam_sin,
                other_x, other_y, other_yaw,
                0.5 * size.length, 0.5 * size.width, scan,
            )  # fmt: skip
    key = hash64(hash64(worlds.key[w], np.uint64(worlds.tick[w])), np.uint64(c))
    apply_sensor_noise(p, key, scan)


@njit(cache=True, error_model="numpy", forceinline=True)
def _step_world(atlas, constants, worlds, w, commands, repeats):
    cars = worlds.state.shape[1]
    for _ in range(repeats):
        worlds.time[w] += constants.timestep
        worlds.tick[w] += 1
        for c in range(cars):
            if worlds.contact[w, c] == FREE:
                _drive(atlas, constants, worlds, w, c, commands[w, c, 0], commands[w, c, 1])
        collide(atlas, worlds, w)
        for c in range(cars):
            _progress(atlas, constants, worlds, w, c)
            _keep_pose(worlds, w, c)
    for c in range(cars):
        _sense(atlas, constants, worlds, w, c)


@njit(cache=True, parallel=True, error_model="numpy")
def step_worlds(atlas: Atlas, constants: Constants, worlds: Worlds, commands: np.ndarray, repeats: int) -> None:
    """Advance every world by `repeats` physics steps under constant commands, then scan.

    Args:
        atlas, constants, worlds: see `atlas` and `worlds`.
        commands: (worlds, cars, 2) steering angle [rad] and speed [m/s] or share of the largest force, see `Simulator`.
        repeats: physics steps.
    """
    for w in prange(worlds.state.shape[0]):
        _step_world(atlas, constants, worlds, np.int64(w), commands, repeats)


@njit(cache=True, error_model="numpy", forceinline=True)
def _put(atlas, constants, worlds, w, c, start):
    """Put a car on the track, at rest but for its speed along its own axis; returns the centreline's length [m]."""
    track = worlds.track[w]
    rows, spacing = atlas.index[track, ROWS], atlas.frame[track, SPACING]
    x, y, heading = frenet_point(atlas.line, atlas.index[track, FIRST_ROW], rows, spacing, start[0], start[1])
    p, state = worlds.params[w, c], worlds.state[w, c]
    derive(constants.model, constants.integrator, constants.timestep / constants.substeps, p)
    speed = float(start[3])
    state[:] = 0.0
    state[column.X], state[column.Y] = x, y
    state[column.YAW] = wrap_angle(heading + start[2])
    state[column.SPEED] = speed
    if constants.model == KINEMATIC:
        state[column.YAW_RATE], state[column.SLIP] = kinematic_values(0.0, speed, p)
    front, rear = rolling_wheel_speeds(0.0, speed, 0.0, 0.0, p)
    state[column.WHEEL_SPEED_FRONT], state[column.WHEEL_SPEED_REAR] = front, rear
    worlds.before[w, c, 0], worlds.before[w, c, 1] = x, y
    worlds.before[w, c, 2] = state[column.YAW]
    held = 0.0 if constants.command == ACCELERATION else speed
    worlds.delayed[w, c, :, 0] = 0.0
    worlds.delayed[w, c, :, 1] = held
    worlds.lagged[w, c, 0] = 0.0
    worlds.lagged[w, c, 1] = held
    for slot in range(worlds.poses.shape[2]):
        for k in range(3):
            worlds.poses[w, c, slot, k] = worlds.before[w, c, k]

    worlds.contact[w, c] = FREE
    worlds.impact_speed[w, c] = 0.0
    worlds.frenet[w, c, ARC_LENGTH] = start[0]
    return _locate(atlas, worlds, w, c)


@njit(cache=True, error_model="numpy", forceinline=True)
def _place(atlas, constants, worlds, w, c, start):
    """Put a car on the track for a new episode."""
    length = _put(atlas, constants, worlds, w, c, start)
    # Unwrapped as given: of two cars, one before and one behind the line, the right one leads.
    worlds.distance[w, c] = start[0]
    from_line = start[0] - length * math.floor(start[0] / length + 0.5)
    worlds.next_line[w, c] = math.floor(start[0] / length) + 1
    worlds.lap_start[w, c] = math.nan
    if abs(from_line) < 1e-3:  # on the line: the first lap is timed from here
        worlds.next_line[w, c] = math.floor(start[0] / length + 0.5) + 1
        worlds.lap_start[w, c] = 0.0
    worlds.laps[w, c] = 0
    worlds.lap_time[w, c] = math.nan


# Apart from the parallel loop below, in which Numba would lose the assignment of rows.
@njit(cache=True, error_model="numpy", forceinline=True)
def _reset_world(atlas, constants, worlds, w, key, track, params, starts, road):
    worlds.key[w] = key
    worlds.track[w] = track
    worlds.time[w] = 0.0
    worlds.tick[w] = 0
    for part in range(road.shape[0]):
        worlds.road[w, part] = road[part]
    for c in range(worlds.state.shape[1]):
        worlds.params[w, c] = params[c]
        _place(atlas, constants, worlds, w, c, starts[c])
    collide(atlas, worlds, w)
    for c in range(worlds.state.shape[1]):
        _sense(atlas, constants, worlds, w, c)


@njit(cache=True, parallel=True, error_model="numpy")
def reset_worlds(
    atlas: Atlas,
    constants: Constants,
    worlds: Worlds,
    which: np.ndarray,
    keys: np.ndarray,
    tracks: np.ndarray,
    params: np.ndarray,
    starts: np.ndarray,
    road: np.ndarray,
) -> None:
    """Begin an episode in some worlds and scan.

    Args:
        atlas, constants, worlds: see `atlas` and `worlds`.
        which: (n,) indices of the worlds.
        keys: uint64 (n,) of their random numbers.
        tracks: (n,) numbers in the atlas.
        params: PARAMETERS (n, cars).
        starts: (n, cars, 4) arc length [m], offset [m], heading error [rad], speed [m/s].
        road: float32 (n, bins), see `Worlds.road`.
    """
    for i in prange(which.shape[0]):
        _reset_world(atlas, constants, worlds, which[i], keys[i], tracks[i], params[i], starts[i], road[i])


@njit(cache=True, error_model="numpy", forceinline=True)
def _respawn(atlas, constants, worlds, w, c, clearance):
    """Put a removed car back on the centreline where it left, if there is room; its clocks and distance go on."""
    track = worlds.track[w]
    start = (worlds.frenet[w, c, ARC_LENGTH], 0.0, 0.0, 0.0)
    x, y, yaw = frenet_point(
        atlas.line, atlas.index[track, FIRST_ROW], atlas.index[track, ROWS], atlas.frame[track, SPACING], start[0], 0.0
    )
    for other in range(worlds.state.shape[1]):
        if other == c or worlds.contact[w, other] == REMOVED:
            continue
        dx, dy = worlds.state[w, other, column.X] - x, worlds.state[w, other, column.Y] - y
        if dx * dx + dy * dy < clearance * clearance:
            return
    p = worlds.params[w, c]
    if not touches_wall(atlas, track, x, y, yaw, 0.5 * p.length, 0.5 * p.width):
        _put(atlas, constants, worlds, w, c, start)
        _sense(atlas, constants, worlds, w, c)


@njit(cache=True, parallel=True, error_model="numpy")
def respawn_cars(atlas: Atlas, constants: Constants, worlds: Worlds, clearance: float) -> None:
    """Put removed cars back on the centreline where they left it, at rest.

    Args:
        atlas, constants, worlds: see `atlas` and `worlds`.
        clearance: [m] to the middle of every other car, without which a car goes on waiting.
    """
    for w in prange(worlds.state.shape[0]):
        for c in range(worlds.state.shape[1]):
            if worlds.contact[w, c] == REMOVED:
                _respawn(atlas, constants, worlds, np.int64(w), c, clearance)
