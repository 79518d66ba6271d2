"""Any car that a configuration accepts, under any command, on any circuit: the simulation stays physical."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from any_worlds import LONGEST_DELAY, campaign, circuits, rows
from outlap.simulator.collision import FREE
from outlap.simulator.dynamics import HIGHEST_YAW_RATE
from outlap.simulator.simulator import MODELS, Simulator, SimulatorConfig
from outlap.simulator.state import SLIP, SPEED, STEER, YAW, YAW_RATE, X, Y
from outlap.track.track import Track

signs = st.floats(-1.0, 1.0) | st.sampled_from([-1.0, 0.0, 1.0])
huge = st.sampled_from([-1e6, 1e6, 0.0]) | st.floats(-1e3, 1e3)


@st.composite
def starts(draw: st.DrawFn, track: Track, row: np.ndarray) -> list[float]:
    """Anywhere on a track, at any speed that the car has."""
    s = draw(st.floats(0.0, 1.0)) * track.centerline.length
    side = draw(signs)
    right, left = track.centerline.widths(s)
    speed = draw(st.floats(0.0, 1.0)) * row["v_max"] if draw(st.booleans()) else draw(signs) * row["v_min"]
    offset = 0.9 * (side * left if side > 0 else side * right)
    return [s, float(offset), 3.0 * draw(signs), float(np.clip(speed, row["v_min"], row["v_max"]))]


def way(track: Track, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Points (n, cars, 2) from where cars were to where they are, half a cell apart."""
    count = math.ceil(2.0 * np.abs(after - before).max() / track.resolution) + 1
    return before + np.linspace(0.0, 1.0, min(count, 2000))[:, None, None] * (after - before)


@pytest.mark.parametrize("model", MODELS)
def test_every_car_stays_finite_within_its_limits_and_inside_the_walls(model):
    tracks = circuits()

    @campaign
    @given(st.data())
    def drive(data: st.DataObject) -> None:
        draw = data.draw
        number, cars = draw(st.integers(0, len(tracks) - 1)), draw(st.integers(1, 4))
        track = tracks[number]
        params = np.stack([draw(rows()) for _ in range(cars)])
        begin = [draw(starts(track, row)) for row in params]
        config = SimulatorConfig(
            model=model, integrator=draw(st.sampled_from(["euler", "rk4"])),
            timestep=draw(st.sampled_from([0.01, 0.001, 0.1])), substeps=draw(st.integers(1, 3)), beams=9,
        )  # fmt: skip
        sim = Simulator(tracks, 1, cars, config, max_delay=LONGEST_DELAY, max_latency=LONGEST_DELAY)
        sim.reset(
            np.arange(1), keys=np.arange(1, dtype=np.uint64), tracks=np.array([number]), params=params[None],
            starts=np.array([begin]),
        )  # fmt: skip
        state, scan = sim.worlds.state[0], sim.worlds.scan[0]
        slowest, fastest = params["v_min"], params["v_max"]
        if model == "drift":
            slowest, fastest = np.minimum(1.2001 * slowest, -0.2001), 1.2001 * fastest
        else:  # the controller looks once a step
            overshoot = 1.0001 * params["a_max"] * config.timestep / config.substeps
            slowest, fastest = slowest - overshoot, fastest + overshoot
        lock = np.maximum(params["steer_max"], -params["steer_min"])
        turning = np.maximum(-slowest, fastest) * np.tan(lock) / (params["lf"] + params["lr"]) * (1 + 1e-5)
        turning = np.maximum(turning, 0.0 if model == "kinematic" else HIGHEST_YAW_RATE)
        for _ in range(draw(st.integers(1, 8))):
            command = [[draw(huge), draw(huge)] for _ in range(cars)]
            for _ in range(draw(st.integers(1, 30))):
                before, parked = state.copy(), sim.worlds.contact[0] != FREE
                sim.step(np.array([command]))
                assert np.isfinite(state).all()
                assert np.isfinite(sim.worlds.frenet).all()
                assert np.isfinite(sim.worlds.distance).all()
                assert (scan >= 0.0).all()
                assert (scan <= params["max_range"][:, None]).all()
                np.testing.assert_array_equal(state[parked], before[parked])
                points = way(track, before[:, [X, Y]].astype(float), state[:, [X, Y]].astype(float))
                assert not track.is_wall(points[..., 0], points[..., 1]).any()
                assert (np.abs(state[:, YAW]) <= np.float32(math.pi)).all()
                assert (np.abs(state[:, SLIP]) <= np.float32(math.pi)).all()
                assert (np.abs(state[:, STEER]) <= lock * (1 + 1e-6) + 1e-6).all()
                assert (np.abs(state[:, YAW_RATE]) <= turning).all()
                assert (state[:, SPEED] >= slowest).all()
                assert (state[:, SPEED] <= fastest).all()

    drive()
