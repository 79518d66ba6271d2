"""Small tracks and the tools that the tests of the environments share."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from outlap.drivers.classical import CenterlineFollower
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.track.centerline import Centerline
from outlap.track.track import Track
from outlap.track.walls import draw_walls
from synthetic_tracks import ring

HALF_WIDTH = 1.1  # [m] of the ellipse


@pytest.fixture(scope="session")
def ellipse() -> Track:
    """45 m around, driven anticlockwise from its rightmost point: half axes 9 m and 5 m."""
    angle = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    points = np.stack([9.0 * np.cos(angle), 5.0 * np.sin(angle)], axis=1)
    line = Centerline.from_points(points, HALF_WIDTH, HALF_WIDTH)
    occupancy, origin = draw_walls(line, 0.05, 0.5)
    return Track("ellipse", occupancy, 0.05, origin, line)


@pytest.fixture(scope="session")
def circle() -> Track:
    """A circle of 4 m radius, 2.4 m wide."""
    return ring(4.0)


@pytest.fixture(scope="session")
def big_circle() -> Track:
    """A circle of 8 m radius, 2.4 m wide."""
    return ring(8.0)


@pytest.fixture(scope="session")
def put() -> Callable[..., None]:
    """Begin an episode in every world from chosen places: `put(env, starts, params=None)`.

    starts: (worlds, cars, 4) or what broadcasts to it: arc length [m], offset [m], heading error [rad], speed [m/s].
    """

    def begin(env: RaceVectorEnv, starts, params: np.ndarray | None = None) -> None:
        env.reset(seed=0)
        simulator, worlds = env.race.simulator, env.race.worlds
        everyone = np.arange(env.num_envs)
        simulator.reset(
            everyone,
            keys=worlds.key.copy(),
            tracks=worlds.track.copy(),
            params=worlds.params.copy() if params is None else params,
            starts=np.broadcast_to(starts, (env.num_envs, env.config.num_cars, 4)),
        )
        assert not worlds.contact.any(), "the test puts a car where it touches something"
        env.race.begin(everyone, env.race.cars.copy())

    return begin


@pytest.fixture(scope="session")
def follow() -> Callable[..., np.ndarray]:
    """Actions that keep the ego on the track: `follow(env, speed_action=0.0, offset=0.0)`, offset [m] to the left."""

    def act(env: RaceVectorEnv, speed_action: float | np.ndarray = 0.0, offset: float = 0.0) -> np.ndarray:
        from outlap.envs.observations import observe

        driver = CenterlineFollower()
        seen = observe(env.race, 0, driver.observation_terms, driver.scale_observations)
        seen["frenet"][:, 0] -= offset
        actions = driver.act(seen)
        actions[:, 1] = speed_action
        return actions

    return act
