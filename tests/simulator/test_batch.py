"""Worlds do not depend on their company, their order, the threads or what was before; steps allocate nothing."""

from __future__ import annotations

import gc
import sys
import tracemalloc

import numba
import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys  # pyright: ignore

from outlap.simulator.simulator import MODELS, Simulator, SimulatorConfig
from synthetic_tracks import CAR, assert_same, place, random_cars, random_commands, ring, snapshot


class Scene:
    """Random cars on mixed tracks with noisy scanners and late actuators, and commands for some steps."""

    def __init__(self, worlds: int, cars: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.tracks = [ring(8.0), ring(5.0, yaw=1.0), ring(11.0, resolution=0.1)]
        self.which_track = rng.integers(0, 3, worlds)
        self.keys = rng.integers(0, 2**63, worlds, dtype=np.uint64)
        self.params = random_cars(rng, worlds, cars)
        self.params["noise_std"], self.params["dropout"] = 0.02, 0.05
        delays, lags = 0.01 * rng.integers(0, 4, (worlds, cars, 2)), rng.uniform(0.0, 0.1, (worlds, cars, 2))
        self.params["steer_delay"], self.params["speed_delay"] = np.moveaxis(delays, -1, 0)
        self.params["steer_lag"], self.params["speed_lag"] = np.moveaxis(lags, -1, 0)
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


@pytest.mark.skipif(numba.get_num_threads() < 2, reason="needs two threads")
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
    params = np.full((2, 1), CAR)
    params["noise_std"] = 0.05
    sim = place(ring(), [[[8.0, 0.0, 1.5]]] * 2, params=params, speed=2.0, beams=40)
    sim.step(np.tile([0.1, 3.0], (2, 1, 1)), 5)
    np.testing.assert_array_equal(sim.worlds.state[0], sim.worlds.state[1])
    assert np.mean(sim.worlds.scan[0] == sim.worlds.scan[1]) < 0.05


def test_a_step_allocates_nothing():
    scene, everyone = Scene(64, 2), np.arange(64)
    sim = scene.simulator(64)
    scene.run(sim, everyone)
    commands = np.zeros((64, 2, 2), np.float32)
    gc.collect()  # so that no array of another test is freed in between
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
        for _ in range(1000):
            sim.step(commands)
        traced, peak = tracemalloc.get_traced_memory()
        # Numba asks every array for its attributes by names made anew, and CPython remembers up to 4096 of them.
        sys._clear_type_cache()
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # A leak would come with every step, and no object is smaller than 16 bytes.
    assert kept < 1000 * 16
    # A temporary copy of the states would be 4.6 kB.
    assert peak - traced < 4096


def test_a_step_changes_the_same_arrays():
    sim = place(ring(), [[[8.0, 0.0, 1.5]]], speed=2.0, beams=3)
    addresses = [array.ctypes.data for array in sim.worlds]
    sim.step(np.array([[[0.0, 2.0]]]))
    assert [array.ctypes.data for array in sim.worlds] == addresses
