"""Pacejka's Magic Formula with combined slip, for the drift model.

Equations: H. B. Pacejka, Tire and Vehicle Dynamics, section 4.3.2, without camber and turn slip, in the
reduced form and sign convention of M. Althoff and G. Würsching, CommonRoad: Vehicle Models, 2020,
section 9.2 and table 7: longitudinal slip is POSITIVE UNDER BRAKING, and the slip angle is that of the
wheel's velocity seen from the wheel, left positive, so that p_ky1 < 0 makes the force oppose it.
"""

from __future__ import annotations

import math

from numba import njit

from outlap.simulator.vehicle import (
    MU,
    P_CX1,
    P_CY1,
    P_DX1,
    P_DY1,
    P_EX1,
    P_EY1,
    P_HX1,
    P_KX1,
    P_KY1,
    P_VX1,
    R_BX1,
    R_BX2,
    R_BY1,
    R_BY2,
    R_BY3,
    R_CX1,
    R_CY1,
    R_EX1,
    R_EY1,
    R_HX1,
    R_HY1,
    R_VY1,
    R_VY4,
    R_VY5,
    R_VY6,
)


@njit(cache=True, error_model="numpy")
def _magic_angle(slope_slip, shape, curvature):
    """C arctan(Bx - E (Bx - arctan Bx)), of which the formula takes the sine or the cosine."""
    return shape * math.atan(slope_slip - curvature * (slope_slip - math.atan(slope_slip)))


@njit(cache=True, error_model="numpy")
def tyre_forces(slip, slip_angle, load, p):
    """Forces of an axle's tyres on the car, in the wheel's frame.

    Args:
        slip: longitudinal slip (u - wheel_radius wheel_speed) / u [-].
        slip_angle: [rad].
        load: vertical force [N].
        p: the car's parameter row.

    Returns:
        longitudinal, lateral [N].
    """
    friction = 1.0 * p[MU]  # a float64 from here on
    # Pacejka's lambda_mu: it scales the peaks and leaves the slopes at the origin alone.
    peak_x = p[P_DX1] * friction / p[P_DY1]

    # Pure slip. The load cancels in the stiffness factors B = K / (C D).
    # CommonRoad adds the vertical shift inside the sine, in newtons; for a 1:10 car it is 1e-4.
    stiffness_x = p[P_KX1] / (p[P_CX1] * peak_x)
    pure_x = (
        peak_x * load * math.sin(_magic_angle(stiffness_x * (p[P_HX1] - slip), p[P_CX1], p[P_EX1]) + load * p[P_VX1])
    )
    stiffness_y = p[P_KY1] / (p[P_CY1] * friction)
    pure_y = friction * load * math.sin(_magic_angle(stiffness_y * slip_angle, p[P_CY1], p[P_EY1]))

    # Combined slip: each force times a cosine magic formula of the other slip, 1 where that is 0.
    # 1 / sqrt(1 + x^2) is cos(arctan x).
    slope = p[R_BX1] / math.sqrt(1.0 + (p[R_BX2] * slip) ** 2)
    force_x = (
        pure_x
        * math.cos(_magic_angle(slope * (slip_angle + p[R_HX1]), p[R_CX1], p[R_EX1]))
        / math.cos(_magic_angle(slope * p[R_HX1], p[R_CX1], p[R_EX1]))
    )
    slope = p[R_BY1] / math.sqrt(1.0 + (p[R_BY2] * (slip_angle - p[R_BY3])) ** 2)
    side_force = (
        friction
        * load
        * p[R_VY1]
        / math.sqrt(1.0 + (p[R_VY4] * slip_angle) ** 2)
        * math.sin(p[R_VY5] * math.atan(p[R_VY6] * slip))
    )
    force_y = (
        pure_y
        * math.cos(_magic_angle(slope * (slip + p[R_HY1]), p[R_CY1], p[R_EY1]))
        / math.cos(_magic_angle(slope * p[R_HY1], p[R_CY1], p[R_EY1]))
        + side_force
    )
    return force_x, force_y
