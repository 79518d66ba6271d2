"""Arc length, laps and lap times on a circle, where all of them are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.simulator.simulator import Simulator, SimulatorConfig
from outlap.simulator.state import STEER, YAW, X, Y
from outlap.simulator.worlds import ARC_LENGTH, HEADING_ERROR, OFFSET
from synthetic_tracks import CAR, place, ring

RADIUS = 8.0
LENGTH = 2.0 * math.pi * RADIUS
MILLISECOND = 1e-3


def circling(starts, speed, radius=RADIUS, params=CAR, timestep=0.01) -> tuple[Simulator, np.ndarray]:
    """Kinematic cars on a circle about the middle of the ring, and the commands that keep them there.

    Args:
        starts: (worlds,) arc lengths [m].
        speed: (worlds,) or scalar [m/s].
    """
    starts = np.asarray(starts, float)
    worlds = len(starts)
    wheelbase = float(params["lf"] + params["lr"])
    slip = math.asin(float(params["lr"]) / radius)  # the velocity is along the circle, the body is not
    steer = math.atan(math.tan(slip) * wheelbase / float(params["lr"]))
    sim = Simulator(
        [ring(RADIUS, half_width=2.0)], worlds, 1, SimulatorConfig(model="kinematic", beams=0, timestep=timestep)
    )
    rows = np.zeros((worlds, 1, 4))
    rows[:, 0, 0] = starts
    rows[:, 0, 1] = RADIUS - radius
    rows[:, 0, 2] = -slip
    rows[:, 0, 3] = speed
    sim.reset(
        np.arange(worlds), keys=np.arange(worlds), tracks=np.zeros(worlds),
        params=np.full((worlds, 1), params), starts=rows,
    )  # fmt: skip
    sim.worlds.state[..., STEER] = steer
    commands = np.empty((worlds, 1, 2))
    commands[..., 0] = steer
    commands[:, 0, 1] = speed
    return sim, commands


def test_frenet_coordinates_of_a_wild_drive_are_those_of_the_circle():
    rng = np.random.default_rng(0)
    angle = rng.uniform(-math.pi, math.pi, 20)
    poses = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), angle + rng.uniform(-2.0, 2.0, 20)], axis=-1)
    sim = place(ring(RADIUS, half_width=2.0), poses[:, None], speed=2.0, beams=0)
    for _ in range(60):
        sim.step(rng.uniform([-0.4, -4.0], [0.4, 8.0], (20, 1, 2)))
        x, y, yaw = sim.worlds.state[:, 0, [X, Y, YAW]].astype(float).T
        frenet = sim.worlds.frenet[:, 0]
        along = RADIUS * np.arctan2(y, x) - frenet[:, ARC_LENGTH]
        np.testing.assert_allclose(along - LENGTH * np.round(along / LENGTH), 0.0, atol=1e-3)
        np.testing.assert_allclose(frenet[:, OFFSET], RADIUS - np.hypot(x, y), atol=1e-3)
        error = yaw - np.arctan2(y, x) - 0.5 * math.pi - frenet[:, HEADING_ERROR]
        np.testing.assert_allclose(error - 2.0 * math.pi * np.round(error / (2.0 * math.pi)), 0.0, atol=1e-3)
        assert ((frenet[:, ARC_LENGTH] >= 0.0) & (frenet[:, ARC_LENGTH] < LENGTH + 1e-3)).all()
        assert (np.abs(frenet[:, HEADING_ERROR]) <= math.pi).all()


@pytest.mark.parametrize("timestep", [0.01, 0.05])
def test_distance_laps_and_lap_times_at_constant_speed(timestep):
    starts = np.array([0.0, 0.3, 20.0, LENGTH - 0.02, -1.5, -LENGTH - 4.0, LENGTH, LENGTH + 3.0, 2.0 * LENGTH, -LENGTH])
    speed = np.linspace(3.0, 6.0, len(starts))
    sim, commands = circling(starts, speed, timestep=timestep)
    np.testing.assert_array_equal(sim.worlds.distance[:, 0], starts)
    np.testing.assert_array_equal(sim.worlds.laps, 0)
    assert np.isnan(sim.worlds.lap_time).all()
    most = 0
    for step in range(1, round(45.0 / timestep) + 1):
        sim.step(commands)
        if step % 7:
            continue
        driven = speed * step * timestep
        # A heading kept in float32 loses up to 1.2e-7 rad a step, and every time the same way.
        drift = 1e-4 + 1.2e-7 * step * RADIUS
        np.testing.assert_allclose(sim.worlds.distance[:, 0], starts + driven, rtol=0.0, atol=drift)
        # The start counts as a crossing only for a car that stands on the line.
        turns = starts / LENGTH
        on_line = np.isclose(turns, np.round(turns), rtol=0.0, atol=1e-6)
        crossings = np.floor(turns + driven / LENGTH + 1e-9) - np.floor(turns + 1e-9)
        sure = np.abs((turns + driven / LENGTH + 0.5) % 1.0 - 0.5) * LENGTH > drift
        laps = np.maximum(crossings - ~on_line, 0)
        np.testing.assert_array_equal(sim.worlds.laps[sure, 0], laps[sure])
        most = max(most, laps.max())
        timed = sure & (laps > 0)
        np.testing.assert_allclose(sim.worlds.lap_time[timed, 0], LENGTH / speed[timed], atol=0.5 * MILLISECOND)
        assert np.isnan(sim.worlds.lap_time[sure & (laps == 0), 0]).all()
        out = sure & ~on_line & (crossings == 0)
        assert np.isnan(sim.worlds.lap_start[out, 0]).all()
        later = sure & ~out
        begun = (LENGTH * (np.floor(turns + 1e-9) + crossings) - starts) / speed
        np.testing.assert_allclose(sim.worlds.lap_start[later, 0], begun[later], atol=0.5 * MILLISECOND)
    assert most >= 4
    assert not sim.worlds.contact.any()


def test_the_line_is_crossed_at_the_right_time_under_full_acceleration():
    params = CAR.copy()
    params["speed_gain"] = 1e3  # full throttle all the way to the target
    ahead, slow = np.linspace(0.5, 2.4, 20), 1.0
    sim, commands = circling(LENGTH - ahead, slow, params=params)
    commands[..., 1] = 20.0
    for _ in range(80):
        sim.step(commands)
    assert slow**2 + 2.0 * params["a_max"] * ahead.max() < params["v_switch"] ** 2
    a = float(params["a_max"])
    exact = (-slow + np.sqrt(slow**2 + 2.0 * a * ahead)) / a
    np.testing.assert_allclose(sim.worlds.lap_start[:, 0], exact, atol=MILLISECOND)


def test_progress_is_measured_along_the_centreline():
    for radius in (7.0, 9.0):  # inside and outside of the line
        sim, commands = circling([0.0], 5.0, radius=radius)
        sim.step(commands, repeats=400)
        assert sim.worlds.distance[0, 0] == pytest.approx(20.0 * RADIUS / radius, abs=2e-3)
        assert sim.worlds.frenet[0, 0, OFFSET] == pytest.approx(RADIUS - radius, abs=1e-3)


def drive_to(sim: Simulator, commands: np.ndarray, distance: float, speed: float) -> None:
    """On along the circle, forwards or backwards, until a distance is passed."""
    direction = math.copysign(1.0, speed)
    commands[..., 1] = speed
    for _ in range(3000):
        if direction * (sim.worlds.distance[0, 0] - distance) > 0.0:
            return
        sim.step(commands)
    pytest.fail("never got there")


def test_backwards_over_the_line_and_forwards_again_is_no_lap():
    sim, commands = circling([LENGTH - 1.0], 3.0)
    drive_to(sim, commands, LENGTH + 0.5, 3.0)
    first = sim.worlds.lap_start[0, 0]
    assert first == pytest.approx(1.0 / 3.0, abs=MILLISECOND)
    for _ in range(2):
        drive_to(sim, commands, LENGTH - 1.0, -3.0)
        drive_to(sim, commands, LENGTH + 0.5, 3.0)
    assert sim.worlds.laps[0, 0] == 0
    assert sim.worlds.lap_start[0, 0] == first
    drive_to(sim, commands, 2.0 * LENGTH - 0.1, 5.0)
    assert sim.worlds.laps[0, 0] == 0
    drive_to(sim, commands, 2.0 * LENGTH + 0.1, 5.0)
    assert sim.worlds.laps[0, 0] == 1
    assert sim.worlds.lap_time[0, 0] == pytest.approx(sim.worlds.lap_start[0, 0] - first, abs=1e-9)


def test_from_the_line_backwards_and_over_it_again_is_no_lap():
    sim, commands = circling([0.0], 0.0)
    drive_to(sim, commands, -2.0, -3.0)
    drive_to(sim, commands, 2.0, 3.0)
    assert sim.worlds.laps[0, 0] == 0
    drive_to(sim, commands, LENGTH + 0.1, 6.0)
    assert sim.worlds.laps[0, 0] == 1
    assert sim.worlds.lap_time[0, 0] > LENGTH / 6.0


def test_whole_laps_backwards_are_distance_lost_and_no_laps():
    sim, commands = circling([1.0], -4.0)
    sim.step(commands, repeats=2600)
    assert sim.worlds.distance[0, 0] == pytest.approx(1.0 - 104.0, abs=5e-3)
    assert sim.worlds.laps[0, 0] == 0
    drive_to(sim, commands, 0.5, 6.0)
    assert sim.worlds.laps[0, 0] == 0


def test_a_reset_forgets_laps():
    sim, commands = circling([0.0], 6.0)
    drive_to(sim, commands, 2.1 * LENGTH, 6.0)
    assert sim.worlds.laps[0, 0] == 2
    worlds, world = sim.worlds, np.array([0])
    starts = np.array([[[5.0, 0.0, 0.0, 1.0]]])
    sim.reset(world, keys=world, tracks=world, params=worlds.params.copy(), starts=starts)
    assert worlds.laps[0, 0] == 0
    assert worlds.distance[0, 0] == 5.0
    assert np.isnan(worlds.lap_time[0, 0])
    assert np.isnan(worlds.lap_start[0, 0])
    assert worlds.time[0] == 0.0


def test_of_two_cars_about_the_line_the_one_ahead_has_the_greater_distance():
    sim, commands = circling([-0.5, 0.5], 5.0)
    for _ in range(50):
        sim.step(commands, repeats=10)
        assert sim.worlds.distance[1, 0] - sim.worlds.distance[0, 0] == pytest.approx(1.0, abs=2e-3)
