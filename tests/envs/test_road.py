"""Friction that varies along the lap: where patches are, what they do to a car, and that they follow the seed."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.road import ROAD_BINS, RoadConfig, draw_road
from outlap.simulator.seeding import world_keys

PATCHES = {"patches": 2, "patch_length": 3.0, "patch_friction": 0.5}


def test_without_patches_there_is_nothing_to_look_up():
    assert draw_road(RoadConfig(), world_keys(range(3)), np.ones(3, int), np.full(3, 40.0)).shape == (3, 0)


def test_patches_have_their_number_length_and_friction():
    """One of 4 m on a lap of 64 m is 16 of 256 parts, in a row, also across the start line; anywhere alike."""
    config = RoadConfig(patches=1, patch_length=4.0, patch_friction=(0.4, 0.8))
    road = draw_road(config, world_keys(range(4000)), np.ones(4000, int), np.full(4000, 64.0))
    assert road.shape == (4000, ROAD_BINS)
    slippery = road < 1.0
    np.testing.assert_array_equal(slippery.sum(1), 16)
    begins = slippery & ~np.roll(slippery, 1, axis=1)
    np.testing.assert_array_equal(begins.sum(1), 1)
    assert (slippery[:, 0] & slippery[:, -1]).mean() == pytest.approx(15 / 256, abs=0.02)
    friction = road.min(axis=1)
    assert friction.min() >= np.float32(0.4)
    assert friction.max() <= np.float32(0.8)
    assert friction.mean() == pytest.approx(0.6, abs=0.01)
    np.testing.assert_allclose(np.bincount(begins.argmax(1) // 32, minlength=8), 500, atol=120)


def test_where_patches_overlap_the_lowest_friction_counts():
    config = RoadConfig(patches=64, patch_length=10.0, patch_friction=(0.3, 0.9))
    road = draw_road(config, world_keys([0]), np.ones(1, int), np.full(1, 20.0))[0]
    assert road.max() < 0.5  # 32 patches on every part


def test_patches_follow_the_seed_and_change_with_every_episode(ellipse):
    def roads(seed: int) -> np.ndarray:
        env = make_race_vector(4, tracks=[ellipse], beams=0, road=PATCHES, termination={"time_limit": 0.02})
        env.reset(seed=seed)
        seen = [env.race.worlds.road.copy()]
        for _ in range(3):
            env.step(np.zeros((4, 2)))
            seen.append(env.race.worlds.road.copy())
        return np.stack(seen)

    first, again, other = roads(1), roads(1), roads(2)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (first[0] != first[-1]).any()
    assert len(np.unique(first[0], axis=0)) == 4


@pytest.mark.parametrize("model", ["single_track", "nonlinear_single_track"])
def test_a_car_has_less_grip_on_a_patch(big_circle, put, model):
    """Half the friction, and so wider out of the same bend; beyond the patch as on a plain road."""
    offsets, friction = [], []
    for slippery in (False, True):
        env = make_race_vector(1, tracks=[big_circle], beams=0, model=model, road={**PATCHES, "patch_length": 0.02})
        env.reset(seed=0)
        worlds = env.race.worlds
        put(env, [0.0, 0.6, 0.0, 5.0])
        worlds.road[:] = 1.0
        worlds.road[:, : ROAD_BINS // 2] = 0.3 if slippery else 1.0
        for _ in range(30):
            env.step(np.array([[0.12, -0.2]]))
        offsets.append(worlds.frenet[0, 0, 1])
        friction.append(worlds.params["road_friction"][0, 0])
    assert friction == pytest.approx([1.0, 0.3])
    assert offsets[1] < offsets[0] - 0.05
