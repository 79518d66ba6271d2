"""The batched step against a plain loop, resets, and drives at the limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from oracles import DelayAndLag
from outlap.simulator.actuators import acceleration, motor_force, steering_rate
from outlap.simulator.dynamics import integrate
from outlap.simulator.elementary import cosine_wide
from outlap.simulator.simulator import INTEGRATORS, MODELS, Simulator, SimulatorConfig
from outlap.simulator.state import N_STATE, SLIP, SPEED, STEER, WHEEL_SPEED_FRONT, WHEEL_SPEED_REAR, YAW, X, Y
from outlap.simulator.vehicle import DERIVED, to_values
from synthetic_tracks import CAR, random_cars, random_commands, ring, yard

# Against a plain loop


def drive_alone(config: SimulatorConfig, params: np.void, state: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """The state of one car after each command, kept in float32 as the simulator does: (steps, N_STATE)."""
    dt, h = config.timestep, config.timestep / config.substeps
    steer_channel = DelayAndLag(0.0, round(float(params["steer_delay"]) / dt), float(params["steer_lag"]), dt)
    speed_channel = DelayAndLag(
        float(state[SPEED]), round(float(params["speed_delay"]) / dt), float(params["speed_lag"]), dt
    )
    states = []
    for steer, speed in np.asarray(commands, np.float32):
        steer_target, speed_target = steer_channel(float(steer)), speed_channel(float(speed))
        now = tuple(float(value) for value in state)
        for _ in range(config.substeps):
            angle = float(params["steer_ratio"]) * steer_target + float(params["steer_trim"])
            rate = steering_rate(angle, now[STEER], h, params)
            if config.model == "nonlinear_single_track":
                push = motor_force(speed_target, now[SPEED] * cosine_wide(now[SLIP]), params) / float(params["m"])
            else:
                push = acceleration(speed_target, now[SPEED], params)
            now = integrate(MODELS[config.model], INTEGRATORS[config.integrator], now, rate, push, h, params)
        state = np.array(now, np.float32)
        states.append(state)
    return np.array(states)


def compare_with_plain_loop(params: np.ndarray, tolerance: float, max_delay: float, seed: int = 0, **config) -> None:
    rng = np.random.default_rng(seed)
    worlds, steps = len(params), 60
    settings = SimulatorConfig(beams=0, **config)
    speed = rng.uniform(0.0, 8.0, (worlds, 1, 1))
    sim = Simulator([yard()], worlds, 1, settings, max_delay)
    starts = np.concatenate([rng.uniform(0.0, 30.0, (worlds, 1, 1)), np.zeros((worlds, 1, 2)), speed], axis=-1)
    sim.reset(np.arange(worlds), keys=np.arange(worlds), tracks=np.zeros(worlds), params=params, starts=starts)
    first = sim.worlds.state.copy()
    held = rng.integers(1, 12, worlds)
    commands = np.empty((steps, worlds, 1, 2))
    for step in range(steps):
        fresh = random_commands(rng, params)
        commands[step] = np.where((step % held == 0)[:, None, None], fresh, commands[step - 1])
    states = np.empty((steps, worlds, 1, N_STATE), np.float32)
    for step in range(steps):
        sim.step(commands[step])
        states[step] = sim.worlds.state
    assert not sim.worlds.contact.any()
    moved = 0
    for world in range(worlds):
        alone = drive_alone(settings, sim.worlds.params[world, 0], first[world, 0], commands[:, world, 0])
        np.testing.assert_allclose(states[:, world, 0], alone, rtol=tolerance, atol=tolerance)
        moved += np.ptp(alone[:, YAW]) > 0.3
    assert moved > worlds // 3


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("integrator", "substeps", "timestep"), [("rk4", 1, 0.01), ("rk4", 3, 0.02), ("euler", 5, 0.01)]
)
def test_a_step_is_that_of_a_plain_loop_bit_for_bit(model, integrator, substeps, timestep):
    params = random_cars(np.random.default_rng(1), 12, 1)
    params["steer_gain"] = np.array([1e6, 8.0, 30.0, 2.0]).repeat(3)[:, None]
    params["steer_delay"] = timestep * np.array([0, 1, 2, 4, 3, 0, 0.4, 0.6, 1.45, 1.55, 4, 4])[:, None]
    params["speed_delay"] = timestep * np.array([0, 0, 1, 3, 0, 2, 4, 4, 0.6, 0, 4, 4])[:, None]
    compare_with_plain_loop(
        params, 0.0, 4 * timestep, model=model, integrator=integrator, substeps=substeps, timestep=timestep
    )


def test_lag_is_the_exact_first_order_one():
    params = random_cars(np.random.default_rng(2), 8, 1)
    params["steer_lag"] = np.array([0.0, 0.02, 0.1, 0.5, 0.0, 0.3, 0.05, 0.001])[:, None]
    params["speed_lag"] = np.array([0.0, 0.0, 0.2, 0.1, 1.0, 0.05, 0.0, 0.001])[:, None]
    params["steer_delay"] = 0.01 * np.array([0, 0, 0, 0, 2, 3, 1, 0])[:, None]
    # Not bit for bit: the lag's output is kept in float32.
    compare_with_plain_loop(params, 1e-4, 0.03, model="kinematic")


def test_a_delayed_command_arrives_after_its_delay_and_not_before():
    params = np.full((3, 1), CAR)
    params["steer_delay"][:, 0] = 0.0, 0.05, 0.0
    params["speed_delay"][:, 0] = 0.0, 0.0, 0.08
    sim = Simulator([yard()], 3, 1, SimulatorConfig(beams=0), max_delay=0.08)
    starts = np.tile([0.0, 0.0, 0.0, 4.0], (3, 1, 1))
    sim.reset(np.arange(3), keys=np.arange(3), tracks=np.zeros(3), params=params, starts=starts)
    steered, pushed = [], []
    for _ in range(10):
        sim.step(np.tile([0.2, 8.0], (3, 1, 1)))
        steered.append(sim.worlds.state[:, 0, STEER] > 0.0)
        pushed.append(sim.worlds.state[:, 0, SPEED] > 4.0)
    assert (~np.array(steered)).sum(0).tolist() == [0, 5, 0]
    assert (~np.array(pushed)).sum(0).tolist() == [0, 0, 8]


# Reset


@pytest.mark.parametrize("model", MODELS)
def test_reset_puts_cars_where_they_are_told_rolling_straight_ahead(model):
    tracks = [ring(8.0), ring(5.0, yaw=0.4)]
    rng = np.random.default_rng(3)
    starts = np.stack(
        [rng.uniform(-60.0, 60.0, (6, 2)), rng.uniform(-0.7, 0.7, (6, 2)), rng.uniform(-3.0, 3.0, (6, 2)),
         rng.uniform(-4.0, 9.0, (6, 2))], axis=-1,
    )  # fmt: skip
    which_track = np.array([0, 1, 1, 0, 1, 0])
    sim = Simulator(tracks, 6, 2, SimulatorConfig(model=model, beams=5))
    params = random_cars(rng, 6, 2)
    sim.reset(np.arange(6), keys=np.arange(6), tracks=which_track, params=params, starts=starts)
    for world in range(6):
        line = tracks[which_track[world]].centerline
        s, d, error, speed = starts[world].T
        state = sim.worlds.state[world]
        np.testing.assert_allclose(state[:, [X, Y]], line.to_cartesian(s, d), atol=1e-5)
        np.testing.assert_allclose(np.exp(1j * state[:, YAW]), np.exp(1j * (line.heading(s) + error)), atol=1e-5)
        np.testing.assert_array_equal(state[:, SPEED], speed.astype(np.float32))
        rolling = speed / params["wheel_radius"][world]
        np.testing.assert_allclose(state[:, WHEEL_SPEED_FRONT], rolling, rtol=1e-6)
        np.testing.assert_allclose(state[:, WHEEL_SPEED_REAR], rolling, rtol=1e-6)
        rest = np.delete(state, [X, Y, YAW, SPEED, WHEEL_SPEED_FRONT, WHEEL_SPEED_REAR], axis=-1)
        np.testing.assert_array_equal(rest, 0.0)
    assert (np.abs(sim.worlds.state[..., YAW]) <= np.float32(math.pi)).all()
    np.testing.assert_array_equal(
        to_values(sim.worlds.params)[..., : -len(DERIVED)], to_values(params)[..., : -len(DERIVED)]
    )
    np.testing.assert_array_equal(sim.worlds.time, 0.0)


# Robust to what it may be given


@pytest.mark.parametrize("model", MODELS)
def test_random_vehicles_under_extreme_commands_stay_finite_and_inside_the_walls(model):
    rng = np.random.default_rng(4)
    tracks = [ring(8.0, half_width=2.5), ring(20.0, half_width=2.0, resolution=0.1, yaw=2.0), yard()]
    worlds, cars = 48, 2
    which_track = np.arange(worlds) % 3
    params = random_cars(rng, worlds, cars)
    sim = Simulator(tracks, worlds, cars, SimulatorConfig(model=model, beams=32, field_of_view=6.0))

    def reset(which):
        starts = np.zeros((len(which), cars, 4))
        starts[..., 0] = rng.uniform([0.0, 10.0], [3.0, 13.0], (len(which), cars))
        starts[..., 2] = rng.uniform(-3.0, 3.0, (len(which), cars))
        starts[..., 3] = rng.uniform(params["v_min"][which], params["v_max"][which])
        sim.reset(which, keys=which, tracks=which_track[which], params=params[which], starts=starts)

    reset(np.arange(worlds))
    commands, crashes, fastest = random_commands(rng, params), 0, 0.0
    for step in range(500):
        change = rng.random((worlds, cars, 1)) < 0.05
        commands = np.where(change, random_commands(rng, params), commands)
        sim.step(commands)
        state = sim.worlds.state
        assert np.isfinite(state).all(), step
        assert np.isfinite(sim.worlds.frenet).all()
        for number, track in enumerate(tracks):
            here = state[which_track == number]
            in_wall = track.is_wall(here[..., X], here[..., Y])
            assert not in_wall.any(), here[in_wall]
        assert (sim.worlds.scan >= 0.0).all()
        assert (sim.worlds.scan <= params["max_range"][..., None]).all()
        assert (state[..., STEER] >= params["steer_min"] - 1e-5).all()
        assert (state[..., STEER] <= params["steer_max"] + 1e-5).all()
        assert (state[..., SPEED] <= params["v_max"] + 0.01 * params["a_max"]).all()
        fastest = max(fastest, state[..., SPEED].max())
        if step % 20 == 19 and sim.worlds.contact.any():
            crashed = np.flatnonzero(sim.worlds.contact.any(axis=1))
            crashes += len(crashed)
            reset(crashed)
    assert crashes > 100
    assert fastest > 15.0
