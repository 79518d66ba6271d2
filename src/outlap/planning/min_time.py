"""The line of least time: an optimal-control problem in the Frenet frame of a line nearby.

The car is a point that steers, with a friction ellipse. Along the arc length s of a reference line of curvature k_r,

    state    n offset to its left, xi direction of travel relative to its tangent, k curvature driven, w = v²
    control  a acceleration along, u change of curvature a metre driven
    with     q = (1 - n k_r) / cos xi, the metres driven per metre of the reference:
             n' = (1 - n k_r) tan xi    xi' = k q - k_r    k' = u q    w' = 2 a q    t' = q / v

and least lap time t, periodic, subject to the ellipse (a / A_x)² + (w k / A_y)² ≤ 1, the motor's power, v_max, steering
lock and rate, and the corridor in which the car's rectangle is free of walls. Direct collocation with the trapezoidal
rule, solved by IPOPT (compare F. Christ et al., Time-optimal trajectory planning for a race car considering variable
tyre-road friction coefficients, Vehicle System Dynamics 59, 2021).
"""

from __future__ import annotations

import casadi
import numpy as np

from outlap.errors import OutlapError
from outlap.planning.corridor import corridor
from outlap.planning.friction import FrictionMap
from outlap.planning.ipopt import QUIET, ended
from outlap.planning.limits import CarLimits
from outlap.planning.path import ClosedPath, path_from
from outlap.planning.speed_profile import speed_profile
from outlap.simulator.bicycle import GRAVITY
from outlap.track.track import Track

POINTS = 2400  # of the collocation, at most
SPACING = 0.15  # [m] of its points where they are fewer
STEEPEST = 0.7  # [rad] of the line to its reference
SLOWEST = 0.3  # [m/s]
SMOOTHNESS = 1e-3  # [s m³] of (change of curvature)²: picks the calmer of lines that are as fast
LANES = 9  # places across the corridor at which friction is looked up, where it differs
ITERATIONS = 400
FULFILLED = 1e-4  # by less, a constraint is not broken

PARAMETERS = ("mu", "a_max", "a_brake", "v_max", "v_switch", "steer_rate_max")  # limits that a solution is for

# What a point must keep to, in the order of the rows of the problem.
CONSTRAINTS = (
    "the friction ellipse", "the motor's power", "the steering rate", "the track's width at the body's corners",
    "the track's width",
)  # fmt: skip
DYNAMICS = ("the offset", "the direction of travel", "the curvature", "the speed")


class MinTimeProblem:
    """The optimal-control problem on a track about a reference line: built once, solved for many cars.

    Args:
        track: to plan on.
        reference: a line that a car can drive, and whose offsets are what is sought.
        body: whose length and width count.
        margin: to the walls, on either side of the car [m].
        friction: that differs from place to place; none: the car's everywhere.
    """

    def __init__(
        self, track: Track, reference: ClosedPath, body: CarLimits, margin: float, friction: FrictionMap | None = None
    ) -> None:
        self.track = track
        self.reference = reference
        self._right, self._left = corridor(track, reference, 0.5 * body.width + margin)
        self._friction = friction
        self._mu, self._lane = self._friction_across()
        self._solver = self._build(body)

    def solve(self, limits: CarLimits) -> ClosedPath:
        """The fastest line for a car with these limits, and the body of the problem; it begins from the reference.

        Raises OutlapError that names the arc length and the constraint where the solver comes to no line.
        """
        low, high = self._variable_bounds(limits)
        constraint_low, constraint_high = self._constraint_bounds()
        found = self._solver(
            x0=self._guess(limits).ravel(), lbx=low.ravel(), ubx=high.ravel(), lbg=constraint_low.ravel(),
            ubg=constraint_high.ravel(), p=[getattr(limits, name) for name in PARAMETERS],
        )  # fmt: skip
        failure = ended(self._solver)
        variables = np.asarray(found["x"]).reshape(low.shape)
        if failure is not None:
            values = np.asarray(found["g"]).reshape(constraint_low.shape)
            excess = np.nan_to_num(np.maximum(constraint_low - values, values - constraint_high), nan=np.inf)
            at_lock = np.abs(variables[:, 2]) > 0.99 * limits.max_curvature
            raise OutlapError(self._complaint(failure, excess, at_lock))
        return self._path(variables)

    def _guess(self, limits: CarLimits) -> np.ndarray:
        """The reference, at its fastest speeds: (n, 6)."""
        curvature, h = self.reference.curvature, self.reference.spacing
        mu = None
        if self._friction is not None:
            mu = self._friction.at(*self.track.centerline.to_frenet(*self.reference.points.T))
        square = speed_profile(curvature, h, limits, mu) ** 2
        zero = np.zeros_like(curvature)
        columns = [
            zero, zero, np.clip(curvature, -limits.max_curvature, limits.max_curvature), square / limits.v_max**2,
            (np.roll(square, -1) - np.roll(square, 1)) / (4.0 * h) / GRAVITY,
            (np.roll(curvature, -1) - np.roll(curvature, 1)) / (2.0 * h),
        ]  # fmt: skip
        return np.column_stack(columns)

    def _variable_bounds(self, limits: CarLimits) -> tuple[np.ndarray, np.ndarray]:
        """What the variables of each point lie between: two (n, 6)."""
        slowest = min(0.9, (SLOWEST / limits.v_max) ** 2)
        low = [-np.inf, -STEEPEST, -limits.max_curvature, slowest, -limits.a_brake / GRAVITY, -np.inf]
        high = [np.inf, STEEPEST, limits.max_curvature, 1.0, limits.a_max / GRAVITY, np.inf]
        n = len(self.reference.points)
        return np.tile(low, (n, 1)), np.tile(high, (n, 1))

    def _constraint_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """What DYNAMICS and CONSTRAINTS of each point lie between: two (n, 9)."""
        n = len(self.reference.points)
        free, one, zeros = np.full((n, 1), np.inf), np.ones((n, 1)), np.zeros((n, len(DYNAMICS)))
        right, left = self._right[:, None], self._left[:, None]
        return np.hstack([zeros, -free, -free, -one, right, right]), np.hstack([zeros, one, one, one, left, left])

    def _path(self, state: np.ndarray) -> ClosedPath:
        offset, direction, curvature = state[:, 0], state[:, 1], state[:, 2]
        driven = (1.0 - offset * self.reference.curvature) / np.cos(direction) * self.reference.spacing
        steps = 0.5 * (driven + np.roll(driven, -1))
        heading = self.reference.heading + direction
        return path_from(self.reference.shifted(offset), heading, curvature, steps, self.reference.spacing)

    def _build(self, body: CarLimits) -> casadi.Function:
        n, h = len(self.reference.points), self.reference.spacing
        z, p = casadi.SX.sym("z", 6), casadi.SX.sym("p", len(PARAMETERS))
        mu, a_max, a_brake, v_max, v_switch, steer_rate_max = casadi.vertsplit(p)
        here = casadi.SX.sym("here", 1 + 2 * LANES)  # curvature of the reference; places across, friction there
        bend = here[0]
        offset, direction, curvature = z[0], z[1], z[2]
        square, along, change = z[3] * v_max**2, z[4] * GRAVITY, z[5]
        speed = casadi.sqrt(square)
        if self._friction is not None:
            # Gaussians about the places across, normalised: smooth, and nowhere beyond what was looked up.
            apart = here[2] - here[1]
            weight = casadi.exp(-0.5 * ((offset - here[1 : 1 + LANES]) / (0.6 * apart)) ** 2) + 1e-9
            mu = casadi.dot(weight, here[1 + LANES :]) / casadi.sum1(weight)
        grip = mu * GRAVITY
        driven = (1.0 - offset * bend) / casadi.cos(direction)
        rates = casadi.vertcat(
            (1.0 - offset * bend) * casadi.tan(direction), curvature * driven - bend, change * driven,
            2.0 * along * driven / v_max**2,
        )  # fmt: skip
        tan_steer = body.wheelbase * curvature
        kept = casadi.vertcat(
            (casadi.fmax(along, 0.0) / casadi.fmin(a_max, grip)) ** 2
            + (casadi.fmin(along, 0.0) / casadi.fmin(a_brake, grip)) ** 2
            + (square * curvature / grip) ** 2,
            along * speed / (a_max * v_switch),
            change * speed * body.wheelbase / (1.0 + tan_steer**2) / steer_rate_max,
            offset - body.length**2 / 8.0 * curvature,
            offset,
        )
        point = casadi.Function("point", [z, here, p], [rates, driven / speed, kept])
        table = np.column_stack([self.reference.curvature, self._lane, self._mu])
        x = casadi.MX.sym("x", 6 * n)
        parameters = casadi.MX.sym("parameters", len(PARAMETERS))
        columns = casadi.reshape(x, 6, n)
        rates_all, pace, kept_all = point.map(n)(columns, casadi.DM(table).T, casadi.repmat(parameters, 1, n))
        state = columns[:4, :]
        defects = _next(state) - state - 0.5 * h * (rates_all + _next(rates_all))
        problem = {
            "x": x,
            "p": parameters,
            "f": h * casadi.sum2(pace) + SMOOTHNESS * h * casadi.sumsqr(columns[5, :]),
            "g": casadi.vec(casadi.vertcat(defects, kept_all)),
        }
        options = {
            "print_time": False,
            "ipopt": {
                **QUIET, "max_iter": ITERATIONS, "tol": 1e-6, "acceptable_tol": 1e-4,
                "acceptable_constr_viol_tol": FULFILLED, "mu_strategy": "adaptive",
            },
        }  # fmt: skip
        return casadi.nlpsol("min_time", "ipopt", problem, options)

    def _friction_across(self) -> tuple[np.ndarray, np.ndarray]:
        """Friction (n, LANES) at places (n, LANES) across the corridor [m]; zeros where it is the same everywhere."""
        n = len(self.reference.points)
        if self._friction is None:
            return np.zeros((n, LANES)), np.zeros((n, LANES))
        lane = self._right[:, None] + np.linspace(0.0, 1.0, LANES) * (self._left - self._right + 0.01)[:, None]
        places = self.reference.points[:, None] + lane[..., None] * self.reference.normal[:, None]
        s, d = self.track.centerline.to_frenet(places[..., 0], places[..., 1])
        return self._friction.at(s, d), lane

    def _complaint(self, failure: str, excess: np.ndarray, at_lock: np.ndarray) -> str:
        """What an unsolved problem is stuck at: the constraint that is broken most, and where."""
        point, row = np.unravel_index(excess.argmax(), excess.shape)
        s = float(self.track.centerline.to_frenet(*self.reference.points[point])[0])
        name = (*(f"the dynamics of {name}" for name in DYNAMICS), *CONSTRAINTS)[row]
        found = f"track {self.track.name}: the solver came to no minimum-time line ({failure}); "
        if excess[point, row] < FULFILLED:
            return (
                f"{found}every constraint is kept, the nearest to being broken is {name} at s = {s:.1f} m, but there "
                "may be faster lines; take min-curvature, or another margin"
            )
        lock = ", where the steering is at its lock" if at_lock[max(0, point - 2) : point + 3].any() else ""
        return (
            f"{found}at s = {s:.1f} m{lock}, {name} is broken by {excess[point, row]:.2g}; take a smaller margin, or a "
            "car that can do more"
        )


def _next(rows: casadi.MX) -> casadi.MX:
    """The columns of a closed line's rows, each in place of the one before."""
    return casadi.horzcat(rows[:, 1:], rows[:, :1])


def spacing_for(path: ClosedPath) -> float:
    """Of the collocation's points on a line [m]."""
    return max(SPACING, path.length / POINTS)
