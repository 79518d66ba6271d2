"""What a car measures of its motion, against the motion itself and the distributions of the errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from oracles import cast_rays_at_walls
from outlap.simulator import state as column
from outlap.simulator.simulator import Simulator, SimulatorConfig
from outlap.simulator.worlds import FORWARD, LEFTWARD, SLIP, STEER, YAW_RATE
from synthetic_tracks import CAR, place, ring, yard


def driven(worlds: int = 1, steps: int = 60, command: tuple[float, float] = (0.15, 5.0), **errors: Any) -> Simulator:
    """Cars in a bend in an open yard."""
    config = {name: errors.pop(name) for name in ("model", "odometry") if name in errors}
    params = np.full((worlds, 1), CAR)
    for name, value in errors.items():
        params[name] = value
    sim = place(
        yard(40.0), np.zeros((worlds, 1, 3)), speed=4.0, params=params,
        **{"model": "nonlinear_single_track", "beams": 0, **config},
    )  # fmt: skip
    for _ in range(steps):
        sim.step(np.full((worlds, 1, 2), command))
    assert not sim.worlds.contact.any()
    return sim


def truth(sim: Simulator) -> np.ndarray:
    """The motion from the states, in the order of `measured`."""
    state = sim.worlds.state.astype(float)
    speed, slip = state[..., column.SPEED], state[..., column.SLIP]
    return np.stack(
        [speed * np.cos(slip), speed * np.sin(slip), state[..., column.YAW_RATE], state[..., column.STEER], slip], -1
    )


@pytest.mark.parametrize("model", ["kinematic", "single_track", "nonlinear_single_track", "drift"])
def test_perfect_sensors_measure_the_motion(model: Any):
    sim = driven(model=model)
    assert abs(truth(sim)[0, 0, SLIP]) > 1e-3
    np.testing.assert_allclose(sim.worlds.measured, truth(sim), rtol=1e-6, atol=1e-6)


def test_a_reset_measures_too():
    sim = driven(steps=0)
    np.testing.assert_allclose(sim.worlds.measured[0, 0], [4.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)


def test_scale_bias_and_trim():
    """The velocity is scaled, the yaw rate shifted, and the servo knows neither its trim nor its ratio."""
    sim = driven(speed_scale=1.1, yaw_rate_bias=0.2, steer_trim=0.03, steer_ratio=1.2)
    exact, seen = truth(sim)[0, 0], sim.worlds.measured[0, 0]
    np.testing.assert_allclose(seen[[FORWARD, LEFTWARD]], 1.1 * exact[[FORWARD, LEFTWARD]], rtol=1e-5)
    assert seen[YAW_RATE] == pytest.approx(exact[YAW_RATE] + 0.2, abs=1e-5)
    assert seen[SLIP] == pytest.approx(exact[SLIP], abs=1e-6)
    assert exact[STEER] == pytest.approx(1.2 * 0.15 + 0.03, abs=1e-6)
    assert seen[STEER] == pytest.approx(0.15, abs=1e-6)


def test_noise_has_its_deviation_and_is_independent():
    """Of car, step and quantity; the motion itself has none."""
    steps, worlds = 20, 400
    sim = driven(worlds, 0, speed_noise=0.1, yaw_rate_noise=0.3)
    errors = []
    for _ in range(steps):
        sim.step(np.full((worlds, 1, 2), (0.1, 4.0)))
        errors.append((sim.worlds.measured - truth(sim))[:, 0, :3])
    assert np.ptp(sim.worlds.state, axis=0).max() == 0.0
    errors = np.stack(errors)  # (steps, worlds, 3)
    for number, deviation in ((FORWARD, 0.1), (LEFTWARD, 0.1), (YAW_RATE, 0.3)):
        values = errors[..., number].ravel()
        assert values.mean() == pytest.approx(0.0, abs=4 * deviation / math.sqrt(values.size))
        assert values.std() == pytest.approx(deviation, rel=0.03)
        assert stats.kstest(values / deviation, "norm").pvalue > 1e-4
    flat = errors.reshape(-1, 3)
    assert np.abs(np.corrcoef(flat.T)[np.triu_indices(3, 1)]).max() < 0.06
    assert abs(np.corrcoef(errors[:-1, :, 0].ravel(), errors[1:, :, 0].ravel())[0, 1]) < 0.06


def test_a_stock_vesc_has_no_lateral_speed_and_the_yaw_rate_of_its_command():
    """Its odometry is that of a car whose wheels do not slip: v tan(commanded angle) / L."""
    sim = driven(odometry="vesc", steer_trim=0.05)
    exact, seen = truth(sim)[0, 0], sim.worlds.measured[0, 0]
    assert seen[LEFTWARD] == seen[SLIP] == 0.0
    assert seen[FORWARD] == pytest.approx(exact[FORWARD], rel=1e-5)
    wheelbase = float(CAR["lf"] + CAR["lr"])
    assert seen[YAW_RATE] == pytest.approx(exact[FORWARD] * math.tan(0.15) / wheelbase, rel=1e-4)
    assert abs(exact[YAW_RATE] - seen[YAW_RATE]) > 0.1


# The scanner's mount and latency


def test_a_scan_is_seen_from_where_the_scanner_is_mounted():
    """Sideways and turned, against exact rays on the wall squares."""
    track, beams, field_of_view = ring(8.0), 61, 4.0
    params = np.full((1, 1), CAR)
    mount = {"mount_x": 0.2, "mount_y": -0.15, "mount_yaw": 0.3}
    for name, value in mount.items():
        params[name] = value
    x, y, yaw = 8.1, 0.2, 1.4
    sim = place(track, [[[x, y, yaw]]], params=params, beams=beams, field_of_view=field_of_view)
    from_x = x + 0.2 * math.cos(yaw) + 0.15 * math.sin(yaw)
    from_y = y + 0.2 * math.sin(yaw) - 0.15 * math.cos(yaw)
    angles = yaw + 0.3 + np.linspace(-0.5, 0.5, beams) * field_of_view
    exact = cast_rays_at_walls(track.occupancy, track.resolution, track.origin, from_x, from_y, angles, 30.0)
    off = np.abs(sim.worlds.scan[0, 0] - exact) > 2e-3
    assert off.mean() <= 0.05  # rays that graze a corner


@pytest.mark.parametrize("late", [0, 1, 7])
def test_a_late_scan_is_that_of_the_pose_some_steps_before(late):
    """Also of other cars; right after a reset there is only the pose of the start."""
    params = np.full((2, 2), CAR)
    params["latency"][0] = 0.01 * late
    sim = Simulator([ring(8.0)], 2, 2, SimulatorConfig(beams=40), max_latency=0.07)
    starts = np.zeros((2, 2, 4))
    starts[:, 1, 0] = 2.0
    starts[..., 3] = 3.0, 5.0
    sim.reset(np.arange(2), keys=np.zeros(2), tracks=np.zeros(2), params=params, starts=starts)
    seen = [sim.worlds.scan.copy()]
    np.testing.assert_array_equal(seen[0][0], seen[0][1])
    for step in range(1, 25):
        sim.step(np.tile([[0.02, 3.0], [0.03, 6.0]], (2, 1, 1)))
        seen.append(sim.worlds.scan.copy())
        np.testing.assert_array_equal(seen[step][0], seen[max(step - late, 0)][1])
    assert np.abs(seen[-1][0] - seen[0][0]).max() > 0.1
