"""The nonlinear single-track model: against Newton's laws written plainly, closed forms and conserved quantities.

The scalar functions are called with float64 records, as in `test_dynamics`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.integrate import solve_ivp

from cars import precise, rolling
from outlap.simulator.actuators import limit_force, motor_force
from outlap.simulator.dynamics import DRIFT, EULER, NONLINEAR_SINGLE_TRACK, RK4, derive, integrate, wrap_angle
from outlap.simulator.nonlinear import axle_scale, lateral_share
from outlap.simulator.vehicle import PRESETS, ActuatorParams, AxleTyres, parameter_bounds

GRAVITY = 9.81
compiles = settings(deadline=None)
unit = st.floats(-1.0, 1.0, allow_subnormal=False)

Manoeuvre = list[tuple[float, float, float]]  # (duration [s], steering rate [rad/s], push [m/s^2])
PUBLISHED_FRONT = (5.5405, 0.4182, 1.8635, 0.3722)  # B, C, D, E of the ForzaETH race stack
PUBLISHED_REAR = (6.6014, 0.5624, 1.7327, 1.0648)
OTHER_REAR = (5.4485, 1.2871, 0.8068, 1.3117)  # of its other set: plain, the force changes sign beyond 1.1 rad


def car(dt: float = 0.01, grip_share: float = 1.0, preset: str = "f1tenth", **changes: Any) -> np.void:
    """A car ready to drive; `front_…` and `rear_…` change its tyres."""
    vehicle = PRESETS[preset]
    tyres = {name: changes.pop(name) for name in list(changes) if name in AxleTyres.model_fields}
    vehicle = vehicle.model_copy(update={**changes, "axles": vehicle.axles.model_copy(update=tyres)})
    row = precise(parameter_bounds(vehicle, ActuatorParams(grip_share=grip_share))[0])
    derive(NONLINEAR_SINGLE_TRACK, RK4, dt, row)
    return row


def drive(state, manoeuvre: Manoeuvre, row, dt=0.01, model=NONLINEAR_SINGLE_TRACK, integrator=RK4):
    for duration, rate, push in manoeuvre:
        for _ in range(round(duration / dt)):
            state = integrate(model, integrator, state, rate, push, dt, row)
    return np.array(state)


# --- the same car from Newton's laws ------------------------------------------------------------------------


def magic_formula(angle, stiffness, shape, curvature):
    """The sine of the Magic Formula, held where its argument would fall (E > 1)."""
    x = stiffness * angle
    if curvature > 1.0:
        x = min(x, 1.0 / math.sqrt(curvature - 1.0))
    return math.sin(shape * math.atan(x - curvature * (x - math.atan(x))))


def tallest(stiffness, shape, curvature):
    """The largest value of the formula up to 90 degrees, by looking at all of it."""
    return max(magic_formula(angle, stiffness, shape, curvature) for angle in np.linspace(0.0, math.pi / 2, 20001))


class Newton:
    """A rigid body on two wheels in the frame of the ground; state x, y, vx, vy, yaw, yaw rate, steering angle."""

    def __init__(self, row) -> None:
        self.p = {name: float(row[name]) for name in row.dtype.names}
        self.peaks = [
            tallest(*(self.p[f"{axle}_{factor}"] for factor in ("B", "C", "E"))) for axle in ("front", "rear")
        ]

    def axle(self, number, velocity, heading, load, demand):
        """The force of an axle [N], as a vector of the ground's frame.

        Args:
            velocity: of the axle's middle [m/s].
            heading: of its wheel [rad].
            load: [N].
            demand: longitudinal force that is asked for [N].
        """
        p, axle = self.p, ("front", "rear")[number]
        along = np.array([math.cos(heading), math.sin(heading)])
        across = np.array([-along[1], along[0]])
        rolling, sliding = velocity @ along, velocity @ across
        grip = p["mu"] * p[f"{axle}_peak"] * load
        most = p["grip_share"] * grip
        share = min(max(demand, -most), most)
        speed = math.hypot(rolling, sliding)
        if share * rolling < 0.0:  # a locked wheel's force opposes its velocity
            share = math.copysign(min(abs(share), most * abs(rolling) / speed), share)
        angle = math.atan2(abs(sliding), max(abs(rolling), p["kinematic_speed"]))
        curve = magic_formula(angle, p[f"{axle}_B"], p[f"{axle}_C"], p[f"{axle}_E"]) / self.peaks[number]
        side = -math.copysign(1.0, sliding) * curve * math.sqrt(grip**2 - share**2)
        return share * along + side * across

    def rates(self, x, rate, push):
        p = self.p
        vx, vy, yaw, yaw_rate, steer = x[2:]
        velocity = np.array([vx, vy])
        nose, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
        transfer = np.clip(push, -p["mu"] * GRAVITY, p["mu"] * GRAVITY) * p["h"]
        wheelbase = p["lf"] + p["lr"]
        front_load = p["m"] * min(max((GRAVITY * p["lr"] - transfer) / wheelbase, 0.0), GRAVITY)
        split = p["engine_split"] if push * (velocity @ nose) >= 0.0 else p["brake_split"]
        force = p["m"] * push
        front = self.axle(0, velocity + yaw_rate * p["lf"] * left, yaw + steer, front_load, split * force)
        rear = self.axle(
            1, velocity - yaw_rate * p["lr"] * left, yaw, p["m"] * GRAVITY - front_load, (1.0 - split) * force
        )
        torque = p["lf"] * (front @ left) - p["lr"] * (rear @ left)
        ax, ay = (front + rear) / p["m"]
        return [vx, vy, ax, ay, yaw_rate, torque / p["I"], rate]

    def drive(self, state, manoeuvre: Manoeuvre):
        """The end of a manoeuvre, as a state of the simulator."""
        x0, y0, steer, speed, yaw, yaw_rate, slip = state[:7]
        x = np.array([x0, y0, speed * math.cos(yaw + slip), speed * math.sin(yaw + slip), yaw, yaw_rate, steer])
        for duration, rate, push in manoeuvre:
            x = solve_ivp(
                lambda _, x, rate=rate, push=push: self.rates(x, rate, push), (0, duration), x, "LSODA",
                rtol=1e-9, atol=1e-9,
            ).y[:, -1]  # fmt: skip
        u = x[2] * math.cos(x[4]) + x[3] * math.sin(x[4])
        v = x[3] * math.cos(x[4]) - x[2] * math.sin(x[4])
        direction = math.copysign(1.0, u)
        return np.array(
            [x[0], x[1], x[6], direction * math.hypot(u, v), wrap_angle(x[4]), x[5], math.atan2(direction * v, abs(u))]
        )


STEP_STEER: Manoeuvre = [(0.5, 0.0, 0.0), (0.1, 2.4, 0.0), (1.4, 0.0, 0.0), (0.2, -2.4, 0.0), (1.0, 0.0, 0.0)]
BRAKE_IN_BEND: Manoeuvre = [(0.1, 0.8, 0.0), (0.5, 0.0, 0.0), (0.6, 0.0, -2.5), (0.5, 0.0, 2.0)]
LOCK_IN_BEND: Manoeuvre = [(0.1, 0.5, 0.0), (0.4, 0.0, 0.0), (0.25, 0.0, -25.0), (0.3, 0.0, 1.0)]
POWER_IN_BEND: Manoeuvre = [(0.1, 1.0, 0.0), (0.5, 0.0, 0.0), (0.3, 0.0, 3.5), (0.1, -2.0, 0.0), (0.3, 0.0, 0.0)]
REVERSE: Manoeuvre = [(0.2, 1.0, 0.0), (0.8, 0.0, 0.0), (0.5, -0.6, -1.0), (0.5, 0.3, 1.5)]


@pytest.mark.parametrize(
    ("manoeuvre", "speed", "changes"),
    [
        (STEP_STEER, 4.0, {}),
        (STEP_STEER, 2.5, {"preset": "forzaeth"}),
        (BRAKE_IN_BEND, 5.0, {}),
        (BRAKE_IN_BEND, 5.0, {"front_E": -1.0, "rear_E": 1.5, "brake_split": 0.7, "h": 0.15}),
        (LOCK_IN_BEND, 6.0, {}),
        (LOCK_IN_BEND, 6.0, {"grip_share": 0.8}),
        (POWER_IN_BEND, 4.0, {"engine_split": 0.0}),
        (POWER_IN_BEND, 4.0, {"grip_share": 0.7, "mu": 0.6}),
        (REVERSE, -4.0, {}),
    ],
)
def test_the_car_drives_as_newton_says(manoeuvre, speed, changes):
    """To a millimetre with the usual step, and a hundred times closer with a tenth of it."""
    for dt, position, angle in ((0.01, 2e-3, 2e-3), (0.001, 2e-5, 2e-5)):
        row = car(**changes)
        state = rolling(speed, row)
        ours, theirs = drive(state, manoeuvre, row, dt)[:7], Newton(row).drive(state, manoeuvre)
        assert theirs[3] * math.copysign(1.0, speed) > row["kinematic_speed"], "the manoeuvre is to stay above it"
        difference = np.array([*(ours - theirs)[:4], wrap_angle(ours[4] - theirs[4]), *(ours - theirs)[5:]])
        limits = [position, position, angle, position, angle, 10 * angle, angle]
        assert np.all(np.abs(difference) <= limits), (dt, difference)


@pytest.mark.parametrize(("integrator", "order"), [(EULER, 1), (RK4, 4)])
def test_convergence_order(integrator, order):
    row, start, turn = car(), rolling(5.0, car()), [(0.32, 0.8, 2.0)]
    exact = drive(start, turn, row, 0.00025)
    coarse, fine = (np.abs(drive(start, turn, row, dt, integrator=integrator) - exact)[:7] for dt in (0.02, 0.01))
    assert np.log2(np.max(coarse) / np.max(fine)) == pytest.approx(order, abs=0.3)


@compiles
@given(unit, unit, unit, unit, unit, unit)
def test_a_mirrored_car_drives_the_mirrored_path(steer, speed, yaw_rate, slip, rate, push):
    row, mirror = car(), np.array([1, -1, -1, 1, -1, -1, -1, 1, 1])
    state = (0.0, 0.0, 0.4 * steer, 6 * speed, 0.0, 8 * yaw_rate, slip, 0.0, 0.0)
    left = drive(state, [(0.1, rate, push * 12), (0.1, -rate, 0.0)], row)
    right = drive(tuple(mirror * state), [(0.1, -rate, push * 12), (0.1, rate, 0.0)], row)
    np.testing.assert_allclose(right, mirror * left, rtol=1e-9, atol=1e-9)


@njit(error_model="numpy")
def drive_at_random(model, integrator, commands, hold, dt, row):
    """The largest magnitude of each state column over a drive; every command is held for `hold` steps."""
    state = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    largest = np.zeros(9)
    for k in range(len(commands) * hold):
        steer, speed = commands[k // hold]
        rate = min(max((steer - state[2]) / dt, -row["steer_rate_max"]), row["steer_rate_max"])
        push = motor_force(speed, state[3] * math.cos(state[6]), row) / row["m"]
        state = integrate(model, integrator, state, rate, push, dt, row)
        for i, value in enumerate(state):
            if not abs(value) <= largest[i]:  # NaN gets in, too
                largest[i] = abs(value)
    return largest


@pytest.mark.parametrize(("integrator", "dt"), [(RK4, 0.01), (EULER, 0.01), (RK4, 0.04)])
def test_random_cars_driven_at_random_stay_finite_and_bounded(integrator, dt):
    rng = np.random.default_rng(7)
    base = np.array(list(car().item()))
    for _ in range(40):
        row = precise(rng.uniform(0.7, 1.3, len(base)) * base)
        row["road_friction"], row["grip_share"] = 1.0, rng.uniform(0.5, 1.0)
        row["mu"], row["front_E"], row["rear_E"] = rng.uniform([0.3, -2.0, -2.0], [1.2, 2.0, 2.0])
        row["brake_split"], row["engine_split"] = rng.uniform(0, 1, 2)
        derive(NONLINEAR_SINGLE_TRACK, integrator, dt, row)
        commands = rng.uniform([row["steer_min"], row["v_min"]], [row["steer_max"], row["v_max"]], (50, 2))
        largest = drive_at_random(NONLINEAR_SINGLE_TRACK, integrator, commands, round(0.2 / dt), dt, row)
        assert np.all(np.isfinite(largest)), (row, largest)
        assert largest[3] <= 1.05 * row["v_max"]
        assert largest[4] <= math.pi
        assert largest[5] <= 50.0
        assert largest[6] <= math.pi / 2


# --- tyres --------------------------------------------------------------------------------------------------


def share(angle, stiffness, shape, curvature):
    """The lateral force / grip at a slip angle [rad], for a wheel that slides to the right."""
    scale = axle_scale(stiffness, shape, curvature)
    return lateral_share(-math.sin(angle), math.cos(angle), 1e-9, stiffness, shape, curvature, scale)


@compiles
@given(st.floats(0.1, 100.0), st.floats(0.05, 1.95), st.floats(-20.0, 2.0))
def test_a_tyres_force_peaks_at_its_grip_and_keeps_its_sign(stiffness, shape, curvature):
    forces = np.array([share(angle, stiffness, shape, curvature) for angle in np.linspace(0.0, math.pi / 2, 4001)])
    assert forces[0] == 0.0
    assert np.all(forces[1:] > 0.0)
    assert forces.max() <= 1.0 + 1e-9
    if stiffness < 10.0 and curvature > -5.0:  # otherwise the peak is narrower than the grid
        assert forces.max() == pytest.approx(1.0, abs=1e-3)


def test_the_published_set_with_E_above_one_keeps_its_sign():
    """Written plainly, its force changes sign beyond 1.1 rad; here it stays where it stops to grow."""
    stiffness, shape, _, curvature = OTHER_REAR
    x = stiffness * 1.5
    assert math.sin(shape * math.atan(x - curvature * (x - math.atan(x)))) < 0.0
    stops = math.atan(math.tan(1.0 / math.sqrt(curvature - 1.0) / stiffness))
    top = share(stops, stiffness, shape, curvature)
    for angle in (0.5, 1.0, 1.2, math.pi / 2):
        assert share(angle, stiffness, shape, curvature) == pytest.approx(top, rel=1e-9)


@pytest.mark.parametrize(("axle", "published"), [("front", PUBLISHED_FRONT), ("rear", PUBLISHED_REAR)])
def test_the_forzaeth_preset_has_the_published_slopes_and_peaks(axle, published):
    row = car(preset="forzaeth")
    stiffness, shape, peak, curvature = published
    slope = row["mu"] * row[f"{axle}_peak"] * share(1e-6, *(row[f"{axle}_{name}"] for name in "BCE")) / 1e-6
    assert slope == pytest.approx(stiffness * shape * peak, rel=1e-3)
    angles = np.linspace(0.0, math.pi / 2, 10001)
    x = np.minimum(stiffness * angles, 1.0 / math.sqrt(curvature - 1.0)) if curvature > 1.0 else stiffness * angles
    forces = peak * np.sin(shape * np.arctan(x - curvature * (x - np.arctan(x))))
    assert row["mu"] * row[f"{axle}_peak"] == pytest.approx(forces.max(), rel=1e-3)


# --- closed forms -------------------------------------------------------------------------------------------


def settled(row, steer: float, speed: float, model=NONLINEAR_SINGLE_TRACK, seconds: float = 3.0) -> np.ndarray:
    """A car that holds its speed and steering angle until it corners steadily: its state."""
    state, dt = rolling(speed, row, steer), 0.005
    for _ in range(round(seconds / dt)):
        held = 20.0 * (speed - state[3])
        state = integrate(model, RK4, state, 0.0, held, dt, row)
    return np.array(state)


@pytest.mark.parametrize("changes", [{}, {"mu": 0.5}, {"front_C": 0.6, "rear_C": 0.7, "front_B": 25.0, "rear_B": 35.0}])
def test_the_largest_steady_lateral_acceleration_is_mu_g(changes):
    """Of an understeering car that steers slowly further; 5 % for the force that turns with the wheel."""
    row = car(**{"h": 0.0, "front_B": 12.0, "rear_B": 18.0, "engine_split": 1.0, **changes})
    state, largest = rolling(5.0, row), 0.0
    for _ in range(1500):
        before = state
        state = integrate(NONLINEAR_SINGLE_TRACK, RK4, state, 0.02, 20.0 * (5.0 - state[3]), 0.01, row)
        turn = wrap_angle(state[4] + state[6] - before[4] - before[6])  # of the velocity
        largest = max(largest, state[3] * turn / 0.01)
    limit = row["mu"] * GRAVITY
    assert 0.95 * limit < largest < 1.01 * limit


@pytest.mark.parametrize("changes", [{}, {"rear_B": 5.0}, {"lf": 0.15, "lr": 0.18}])
def test_the_understeer_gradient_follows_from_stiffnesses_and_loads(changes):
    """steer = L / R + K a_y with K = (m_f / C_f - m_r / C_r), for small angles."""
    row = car(**{"h": 0.0, **changes})
    wheelbase = row["lf"] + row["lr"]
    front_slope = row["mu"] * row["front_B"] * row["front_C"] * row["front_scale"]
    rear_slope = row["mu"] * row["rear_B"] * row["rear_C"] * row["rear_scale"]
    gradient = (1.0 / front_slope - 1.0 / rear_slope) / GRAVITY  # loads cancel: both axles carry a_y / g
    steer, speed = 0.002, 3.0
    state = settled(row, steer, speed)
    lateral = state[5] * state[3]
    assert steer - wheelbase * state[5] / state[3] == pytest.approx(gradient * lateral, rel=0.02, abs=1e-7)


def test_an_oversteering_car_is_unstable_above_its_critical_speed():
    """v² = L g / (1 / C_r - 1 / C_f): a small yaw rate dies out below and grows above."""
    row = car(h=0.0, front_B=6.0, rear_B=3.0)
    slopes = [row["mu"] * row[f"{axle}_B"] * row[f"{axle}_C"] * row[f"{axle}_scale"] for axle in ("front", "rear")]
    wheelbase = row["lf"] + row["lr"]
    critical = math.sqrt(wheelbase * GRAVITY / (1.0 / slopes[1] - 1.0 / slopes[0]))
    assert critical > 2 * row["kinematic_speed"]
    for speed, grows in ((0.93 * critical, False), (1.07 * critical, True)):
        state = (0.0, 0.0, 0.0, speed, 0.0, 1e-6, 0.0, 0.0, 0.0)
        early = abs(drive(state, [(2.0, 0.0, 0.0)], row)[5])
        late = abs(drive(state, [(4.0, 0.0, 0.0)], row)[5])
        assert (late > early) == grows, (speed, critical, early, late)


@pytest.mark.parametrize(("brake_force", "mu"), [(20.0, 1.0), (100.0, 1.0), (100.0, 0.4)])
def test_the_braking_distance_follows_from_brakes_or_grip(brake_force, mu):
    """v² / (2 min(mu g, F / m)), on four wheels that share the brakes as they share the load."""
    row = car(brake_force=brake_force, mu=mu, h=0.0, lf=0.16, lr=0.16)
    deceleration = min(row["mu"] * GRAVITY, row["brake_force"] / row["m"])
    state, start = rolling(8.0, row), 8.0
    while state[3] > 1e-3:
        push = limit_force(max(-1e9, -state[3] / 0.01 * row["m"]), state[3], row) / row["m"]
        state = integrate(NONLINEAR_SINGLE_TRACK, RK4, state, 0.0, push, 0.01, row)
    assert state[0] == pytest.approx(start**2 / (2.0 * deceleration), rel=0.01)


def test_power_limits_the_acceleration():
    """From P t = m v² / 2 above the speed at which power rather than force limits the motor."""
    row = car(motor_power=60.0, motor_force=30.0, v_max=20.0)
    state = rolling(4.0, row)
    for _ in range(200):
        push = motor_force(20.0, state[3], row) / row["m"]
        state = integrate(NONLINEAR_SINGLE_TRACK, RK4, state, 0.0, push, 0.01, row)
    assert state[3] == pytest.approx(math.sqrt(4.0**2 + 2.0 * 60.0 * 2.0 / row["m"]), rel=0.003)


def test_a_heavier_car_accelerates_and_brakes_less():
    speeds = []
    for mass in (3.0, 6.0):
        row = car(m=mass, I=0.0126 * mass, motor_force=20.0, brake_force=12.0)  # within the grip
        faster = drive(rolling(3.0, row), [(0.5, 0.0, motor_force(20.0, 3.0, row) / row["m"])], row)[3] - 3.0
        slower = drive(rolling(3.0, row), [(0.2, 0.0, limit_force(-1e3, 3.0, row) / row["m"])], row)[3] - 3.0
        speeds.append((faster, slower))
    np.testing.assert_allclose(np.divide(*speeds), 2.0, rtol=1e-3)
    assert speeds[0][0] > 0.0 > speeds[0][1]


@compiles
@given(st.floats(-8.0, 8.0), unit, unit, unit, st.sampled_from(["f1tenth", "forzaeth"]), st.sampled_from([0.0, 1.3117]))
def test_a_coasting_car_never_gains_energy(speed, slip, spin, steer, preset, curvature):
    """From any state: sliding sideways, spinning, backwards. A thousandth for the integrator."""
    row = car(dt=0.002, preset=preset, rear_E=curvature)
    state = (0.0, 0.0, 0.4 * steer, speed, 0.0, 30.0 * spin, slip * math.pi / 2, 0.0, 0.0)

    def energy(state) -> float:
        return 0.5 * row["m"] * state[3] ** 2 + 0.5 * row["I"] * state[5] ** 2

    for _ in range(300):
        before = state
        state = integrate(NONLINEAR_SINGLE_TRACK, RK4, state, 0.0, 0.0, 0.002, row)
        if min(abs(before[3]), abs(state[3])) > row["kinematic_speed"]:  # below, wheels roll by constraint
            assert energy(state) <= energy(before) * (1.0 + 1e-3) + 1e-9


# --- against the drift model --------------------------------------------------------------------------------


def twin(**changes: Any) -> np.void:
    """A car whose tyres are the same under both models: B = -p_ky1 / (C mu), C = p_cy1, E = p_ey1.

    The drift model's friction for the lateral force is mu; the longitudinal one, mu p_dx1 / p_dy1, counts little here.
    """
    row = car(wheel_inertia=6e-5, **changes)  # the other model has no wheels that store energy
    row["p_ky1"] = -row["C_Sf"] * row["p_dy1"]
    for axle in ("front", "rear"):
        row[f"{axle}_C"], row[f"{axle}_E"] = row["p_cy1"], row["p_ey1"]
        row[f"{axle}_B"] = -row["p_ky1"] / (row["p_cy1"] * row["p_dy1"])
    derive(NONLINEAR_SINGLE_TRACK, RK4, 0.01, row)
    return row


@pytest.mark.parametrize(("steer", "speed"), [(0.05, 4.0), (0.1, 4.0), (0.2, 3.0), (0.15, 4.0)])
def test_it_corners_steadily_as_the_drift_model(steer, speed):
    row = twin()
    ours, theirs = settled(row, steer, speed), settled(row, steer, speed, DRIFT)
    assert ours[5] == pytest.approx(theirs[5], rel=0.03)
    assert ours[6] == pytest.approx(theirs[6], abs=0.01)


@pytest.mark.parametrize(
    ("manoeuvre", "position"),
    [
        ([(0.3, 0.0, 0.0), (0.1, 1.0, 0.0), (1.0, 0.0, 0.0)], 0.05),
        ([(0.1, 1.0, 0.0), (0.4, 0.0, 0.0), (0.6, 0.0, -3.0)], 0.1),
    ],
)
def test_it_steers_and_brakes_in_a_bend_as_the_drift_model(manoeuvre, position):
    row = twin()
    ours, theirs = (drive(rolling(4.0, row), manoeuvre, row, 0.005, model) for model in (NONLINEAR_SINGLE_TRACK, DRIFT))
    assert np.hypot(*(ours - theirs)[:2]) < position
    assert ours[3] == pytest.approx(theirs[3], abs=0.1)
    assert ours[4] == pytest.approx(theirs[4], abs=0.05)
    assert ours[5] == pytest.approx(theirs[5], abs=0.15)
