"""The batched step against a plain loop, its independence of company and threads, and what it refuses."""

from __future__ import annotations

import math
import tracemalloc

import numba
import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from oracles import DelayAndLag
from outlap.errors import OutlapError
from outlap.simulator.actuators import acceleration, steering_rate
from outlap.simulator.dynamics import integrate
from outlap.simulator.kernels import Worlds
from outlap.simulator.simulator import INTEGRATORS, MODELS, Simulator, SimulatorConfig
from outlap.simulator.state import N_STATE, SPEED, STEER, WHEEL_SPEED_FRONT, WHEEL_SPEED_REAR, YAW, X, Y
from outlap.simulator.vehicle import (
    A_MAX,
    DROPOUT,
    KINEMATIC_SPEED,
    LR,
    MAX_RANGE,
    N_PARAMS,
    NOISE_STD,
    SPEED_DELAY,
    SPEED_LAG,
    STEER_DELAY,
    STEER_GAIN,
    STEER_LAG,
    STEER_MAX,
    STEER_MIN,
    V_MAX,
    V_MIN,
    WHEEL_RADIUS,
)
from outlap.track.track import Track
from synthetic_tracks import CAR, hall, place, ring


def yard() -> Track:
    """An empty hall 40 m × 40 m about the map frame's origin."""
    return hall(np.zeros((200, 200), bool), 0.2, (-20.0, -20.0, 0.0))


def random_cars(rng: np.random.Generator, worlds: int, cars: int, **columns) -> np.ndarray:
    """Parameter rows within 30 % of the F1TENTH car's."""
    params = CAR * rng.uniform(0.7, 1.3, (worlds, cars, N_PARAMS))
    return params.astype(np.float32)


def random_commands(rng: np.random.Generator, params: np.ndarray) -> np.ndarray:
    """At or near the limits of each car, both ways, or nothing: (worlds, cars, 2)."""
    choice = rng.integers(0, 3, params.shape[:-1])
    steer = np.choose(choice, [params[..., STEER_MIN], params[..., STEER_MAX], 0.0 * choice])
    choice = rng.integers(0, 4, params.shape[:-1])
    speed = np.choose(choice, [params[..., V_MIN], params[..., V_MAX], 0.0 * choice, 0.4 * params[..., V_MAX]])
    return np.stack([steer, speed], axis=-1)


# Against a plain loop


def drive_alone(config: SimulatorConfig, params: np.ndarray, state: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """The state of one car after each command, kept in float32 as the simulator does: (steps, N_STATE)."""
    dt, h = config.timestep, config.timestep / config.substeps
    steer_channel = DelayAndLag(0.0, round(float(params[STEER_DELAY]) / dt), float(params[STEER_LAG]), dt)
    speed_channel = DelayAndLag(
        float(state[SPEED]), round(float(params[SPEED_DELAY]) / dt), float(params[SPEED_LAG]), dt
    )
    states = []
    for steer, speed in np.asarray(commands, np.float32):
        steer_target, speed_target = steer_channel(float(steer)), speed_channel(float(speed))
        now = tuple(float(value) for value in state)
        for _ in range(config.substeps):
            rate = steering_rate(steer_target, now[STEER], h, params)
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
    params[..., STEER_GAIN] = np.array([1e6, 8.0, 30.0, 2.0]).repeat(3)[:, None]
    params[..., STEER_DELAY] = timestep * np.array([0, 1, 2, 4, 3, 0, 0.4, 0.6, 1.45, 1.55, 4, 4])[:, None]
    params[..., SPEED_DELAY] = timestep * np.array([0, 0, 1, 3, 0, 2, 4, 4, 0.6, 0, 4, 4])[:, None]
    compare_with_plain_loop(
        params, 0.0, 4 * timestep, model=model, integrator=integrator, substeps=substeps, timestep=timestep
    )


def test_lag_is_the_exact_first_order_one():
    params = random_cars(np.random.default_rng(2), 8, 1)
    params[..., STEER_LAG] = np.array([0.0, 0.02, 0.1, 0.5, 0.0, 0.3, 0.05, 0.001])[:, None]
    params[..., SPEED_LAG] = np.array([0.0, 0.0, 0.2, 0.1, 1.0, 0.05, 0.0, 0.001])[:, None]
    params[..., STEER_DELAY] = 0.01 * np.array([0, 0, 0, 0, 2, 3, 1, 0])[:, None]
    # Not bit for bit: the lag's output is kept in float32.
    compare_with_plain_loop(params, 1e-4, 0.03, model="kinematic")


def test_a_delayed_command_arrives_after_its_delay_and_not_before():
    params = np.tile(CAR, (3, 1, 1))
    params[:, 0, STEER_DELAY] = 0.0, 0.05, 0.0
    params[:, 0, SPEED_DELAY] = 0.0, 0.0, 0.08
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
        rolling = speed / params[world, :, WHEEL_RADIUS]
        np.testing.assert_allclose(state[:, WHEEL_SPEED_FRONT], rolling, rtol=1e-6)
        np.testing.assert_allclose(state[:, WHEEL_SPEED_REAR], rolling, rtol=1e-6)
        rest = np.delete(state, [X, Y, YAW, SPEED, WHEEL_SPEED_FRONT, WHEEL_SPEED_REAR], axis=-1)
        np.testing.assert_array_equal(rest, 0.0)
    assert (np.abs(sim.worlds.state[..., YAW]) <= np.float32(math.pi)).all()
    np.testing.assert_array_equal(sim.worlds.params[..., :KINEMATIC_SPEED], params[..., :KINEMATIC_SPEED])
    np.testing.assert_array_equal(sim.worlds.time, 0.0)


def snapshot(sim: Simulator, world: int | slice = slice(None)) -> dict[str, np.ndarray]:
    return {name: getattr(sim.worlds, name)[world].copy() for name in Worlds._fields if name != "delayed"}


def assert_same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


class Scene:
    """Random cars on mixed tracks with noisy scanners and late actuators, and commands for some steps."""

    def __init__(self, worlds: int, cars: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.tracks = [ring(8.0), ring(5.0, yaw=1.0), ring(11.0, resolution=0.1)]
        self.which_track = rng.integers(0, 3, worlds)
        self.keys = rng.integers(0, 2**63, worlds, dtype=np.uint64)
        self.params = random_cars(rng, worlds, cars)
        self.params[..., [NOISE_STD, DROPOUT]] = 0.02, 0.05
        self.params[..., [STEER_DELAY, SPEED_DELAY]] = 0.01 * rng.integers(0, 4, (worlds, cars, 2))
        self.params[..., [STEER_LAG, SPEED_LAG]] = rng.uniform(0.0, 0.1, (worlds, cars, 2))
        self.starts = np.zeros((worlds, cars, 4))
        self.starts[..., 0] = 7.0 * np.arange(cars) + rng.uniform(0.0, 5.0, (worlds, cars))
        self.starts[..., 1] = rng.uniform(-0.5, 0.5, (worlds, cars))
        self.starts[..., 3] = rng.uniform(0.0, 6.0, (worlds, cars))
        self.commands = np.stack([random_commands(rng, self.params) for _ in range(30)])

    def simulator(self, worlds: int, **config) -> Simulator:
        return Simulator(self.tracks, worlds, self.params.shape[1], SimulatorConfig(beams=40, **config), 0.03)

    def reset(self, sim: Simulator, into: np.ndarray, worlds: np.ndarray) -> None:
        """Begin some of the scene's worlds in worlds of a simulator."""
        sim.reset(
            into, keys=self.keys[worlds], tracks=self.which_track[worlds], params=self.params[worlds],
            starts=self.starts[worlds],
        )  # fmt: skip

    def run(self, sim: Simulator, worlds: np.ndarray, repeats: int = 2) -> None:
        self.reset(sim, np.arange(len(worlds)), worlds)
        for command in self.commands:
            sim.step(command[worlds], repeats)


@pytest.mark.parametrize("model", MODELS)
def test_a_batch_of_64_worlds_is_64_simulators_bit_for_bit(model):
    scene, everyone = Scene(64, 2), np.arange(64)
    batch = scene.simulator(64, model=model)
    scene.run(batch, everyone)
    assert 0.05 < np.mean(batch.worlds.contact > 0) < 0.95
    alone = scene.simulator(1, model=model)  # used again and again: a reset must leave nothing behind
    for world in everyone:
        scene.run(alone, np.array([world]))
        assert_same(snapshot(alone, 0), snapshot(batch, world))


def test_worlds_in_another_order_give_the_same_in_that_order():
    scene, everyone = Scene(32, 3), np.arange(32)
    order = np.random.default_rng(0).permutation(32)
    first, second = scene.simulator(32), scene.simulator(32)
    scene.run(first, everyone)
    scene.run(second, order)
    assert_same(snapshot(first, order), snapshot(second))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
@pytest.mark.parametrize("model", MODELS)
def test_the_number_of_threads_changes_nothing(model):
    scene, everyone = Scene(33, 2), np.arange(33)
    snapshots = []
    threads = numba.get_num_threads()
    try:
        for count in (1, 2):
            numba.set_num_threads(count)
            sim = scene.simulator(33, model=model)
            scene.run(sim, everyone)
            snapshots.append(snapshot(sim))
    finally:
        numba.set_num_threads(threads)
    assert_same(*snapshots)


def test_control_repeats_are_as_many_steps():
    scene, everyone = Scene(16, 2), np.arange(16)
    once, often = scene.simulator(16), scene.simulator(16)
    for sim in (once, often):
        scene.reset(sim, everyone, everyone)
    for command in scene.commands:
        once.step(command, repeats=4)
        for _ in range(4):
            often.step(command)
        assert_same(snapshot(once), snapshot(often))
    np.testing.assert_array_equal(once.worlds.tick, 120)
    np.testing.assert_allclose(once.worlds.time, 1.2, atol=1e-12)


def test_a_reset_of_some_worlds_leaves_the_others_alone():
    scene, everyone = Scene(12, 2), np.arange(12)
    sim, undisturbed = scene.simulator(12), scene.simulator(12)
    for each in (sim, undisturbed):
        scene.reset(each, everyone, everyone)
    again, others = np.array([7, 2, 11]), np.delete(everyone, [7, 2, 11])
    for k, command in enumerate(scene.commands):
        if k == 10:
            scene.reset(sim, again, again)
        sim.step(command)
        undisturbed.step(command)
    assert_same(snapshot(sim, others), snapshot(undisturbed, others))
    # And the worlds that began anew are where new ones would be.
    scene.reset(undisturbed, everyone, everyone)
    for command in scene.commands[10:]:
        undisturbed.step(command)
    assert_same(snapshot(sim, again), snapshot(undisturbed, again))


def test_the_same_reset_in_two_worlds_with_other_keys_differs_in_the_noise_only():
    params = np.tile(CAR, (2, 1, 1))
    params[..., NOISE_STD] = 0.05
    sim = place(ring(), [[[8.0, 0.0, 1.5]]] * 2, params=params, speed=2.0, beams=40)
    sim.step(np.tile([0.1, 3.0], (2, 1, 1)), 5)
    np.testing.assert_array_equal(sim.worlds.state[0], sim.worlds.state[1])
    assert np.mean(sim.worlds.scan[0] == sim.worlds.scan[1]) < 0.05


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
        starts[..., 3] = rng.uniform(params[which, :, V_MIN], params[which, :, V_MAX])
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
        assert (sim.worlds.scan <= params[..., MAX_RANGE, None]).all()
        assert (state[..., STEER] >= params[..., STEER_MIN] - 1e-5).all()
        assert (state[..., STEER] <= params[..., STEER_MAX] + 1e-5).all()
        assert (state[..., SPEED] <= params[..., V_MAX] + 0.01 * params[..., A_MAX]).all()
        fastest = max(fastest, state[..., SPEED].max())
        if step % 20 == 19 and sim.worlds.contact.any():
            crashed = np.flatnonzero(sim.worlds.contact.any(axis=1))
            crashes += len(crashed)
            reset(crashed)
    assert crashes > 100
    assert fastest > 15.0


def test_a_step_allocates_nothing():
    scene, everyone = Scene(16, 2), np.arange(16)
    sim = scene.simulator(16)
    scene.run(sim, everyone)
    commands = np.zeros((16, 2, 2), np.float32)
    counted = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        for _ in range(100):
            sim.step(commands, 2)
        after = rtsys.get_allocation_stats()
    finally:
        if not counted:
            _nrt_python.memsys_disable_stats()
    # Numba makes a record of every array that it is passed, and frees it; that is all.
    arrays = len(sim.atlas) + len(sim.worlds) + len(["beam_cos", "beam_sin", "commands"])
    assert after.alloc - before.alloc == after.free - before.free == 100 * arrays
    tracemalloc.start()
    try:
        sim.step(commands)
        tracemalloc.clear_traces()
        for _ in range(100):
            sim.step(commands)
        kept, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 512
    assert peak < 4096  # the Python call itself; the scans alone are 5 kB


def test_a_step_changes_the_same_arrays():
    sim = place(ring(), [[[8.0, 0.0, 1.5]]], speed=2.0, beams=3)
    addresses = [array.ctypes.data for array in sim.worlds]
    sim.step([[[0.0, 2.0]]])
    assert [array.ctypes.data for array in sim.worlds] == addresses


# What it refuses


def good() -> dict[str, np.ndarray]:
    """Arguments of a reset of two worlds of two cars."""
    return {
        "which": np.arange(2),
        "keys": np.arange(2, dtype=np.uint64),
        "tracks": np.zeros(2, int),
        "params": np.tile(CAR, (2, 2, 1)),
        "starts": np.zeros((2, 2, 4)),
    }


def changed(name: str, where, value) -> np.ndarray:
    array = good()[name].astype(float)
    array[where] = value
    return array


@pytest.fixture(scope="module")
def sim() -> Simulator:
    sim = Simulator([ring()], 2, 2, SimulatorConfig(beams=4))
    arguments = good()
    sim.reset(arguments.pop("which"), **arguments)
    return sim


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("which", [0, 2]), ("which", [-1, 0]),
        ("keys", np.arange(1, dtype=np.uint64)), ("keys", np.zeros((2, 2), np.uint64)),
        ("tracks", [0]), ("tracks", [0, 1]), ("tracks", [-1, 0]),
        ("params", np.tile(CAR, (2, 1))), ("params", np.tile(CAR[:-1], (2, 2, 1))),
        ("params", changed("params", (1, 0, LR), np.nan)), ("params", changed("params", (0, 1, MAX_RANGE), np.inf)),
        ("params", changed("params", (0, 0, STEER_DELAY), 0.02)),
        ("params", changed("params", (0, 0, SPEED_DELAY), 0.01)),
        ("params", changed("params", (0, 0, STEER_DELAY), np.nan)),
        ("starts", np.zeros((2, 4))), ("starts", np.zeros((2, 2, 3))),
        ("starts", changed("starts", (0, 1, 3), np.nan)), ("starts", changed("starts", (0, 0, 0), np.inf)),
    ],
)  # fmt: skip
def test_a_reset_with_bad_input_names_it_and_changes_nothing(sim, name, value):
    before = snapshot(sim)
    arguments = good() | {name: value}
    with pytest.raises(OutlapError, match=name) as caught:
        sim.reset(arguments.pop("which"), **arguments)
    assert "\n" not in str(caught.value)
    assert_same(before, snapshot(sim))


def test_a_reset_of_no_world_is_fine(sim):
    before = snapshot(sim)
    arguments = {name: value[:0] for name, value in good().items()}
    sim.reset(arguments.pop("which"), **arguments)
    assert_same(before, snapshot(sim))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_commands_that_are_not_finite_are_refused_by_world_and_car(sim, value):
    before = snapshot(sim)
    commands = np.zeros((2, 2, 2))
    commands[1, 0, 1] = value
    with pytest.raises(OutlapError, match=r"commands.*car 0 in world 1"):
        sim.step(commands)
    assert_same(before, snapshot(sim))


@pytest.mark.parametrize("shape", [(2, 2), (2, 2, 3), (1, 2, 2), (2, 1, 2), (0,)])
def test_commands_of_another_shape_are_refused(sim, shape):
    with pytest.raises(OutlapError, match="commands has shape"):
        sim.step(np.zeros(shape))


@pytest.mark.parametrize("repeats", [0, -1])
def test_a_step_of_no_physics_steps_is_refused(sim, repeats):
    with pytest.raises(OutlapError, match="repeats"):
        sim.step(np.zeros((2, 2, 2)), repeats)


def test_a_world_that_was_never_reset_is_named():
    sim = Simulator([ring()], 3, 1, SimulatorConfig(beams=0))
    arguments = {name: value[:2, :1] if value.ndim > 1 else value for name, value in good().items()}
    sim.reset(arguments.pop("which"), **arguments)
    with pytest.raises(OutlapError, match="world 2 was never reset"):
        sim.step(np.zeros((3, 1, 2)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("timestep", 0.0), ("timestep", -0.01), ("timestep", 0.11), ("substeps", 0), ("beams", -1),
        ("beams", 1081), ("field_of_view", 0.0), ("field_of_view", 6.3),
    ],
)  # fmt: skip
def test_a_configuration_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        Simulator([ring()], 1, 1, SimulatorConfig(**{field: value}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tracks", []), ("num_worlds", 0), ("num_cars", 0), ("max_delay", 100.0), ("max_delay", -0.05),
        ("max_delay", math.nan), ("max_delay", math.inf),
    ],
)  # fmt: skip
def test_a_simulator_that_cannot_be_is_refused_by_name(name, value):
    arguments = {"tracks": [ring()], "num_worlds": 1, "num_cars": 1, "max_delay": 0.0} | {name: value}
    with pytest.raises(OutlapError, match=name):
        Simulator(**arguments)
