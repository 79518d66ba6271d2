"""Pacejka's Magic Formula with combined slip, for the drift model.

Equations: H. B. Pacejka, Tire and Vehicle Dynamics, section 4.3.2, without camber and turn slip, in the
reduced form and sign convention of M. Althoff and G. Würsching, CommonRoad: Vehicle Models, 2020,
section 9.2 and table 7: longitudinal slip is POSITIVE UNDER BRAKING, and the slip angle is that of the
wheel's velocity seen from the wheel, left positive, so that p_ky1 < 0 makes the force oppose it.
"""

# pyright: basic
# Numba infers the types of kernels; annotations would repeat them and compile nothing.

from __future__ import annotations

import math

from numba import njit


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
        p: the car's parameters.

    Returns:
        longitudinal, lateral [N].
    """
    friction = 1.0 * p.mu * p.road_friction  # a float64 from here on
    # Pacejka's lambda_mu: it scales the peaks and leaves the slopes at the origin alone.
    peak_x = p.p_dx1 * friction / p.p_dy1

    # Pure slip. The load cancels in the stiffness factors B = K / (C D).
    # CommonRoad adds the vertical shift inside the sine, in newtons; for a 1:10 car it is 1e-4.
    stiffness_x = p.p_kx1 / (p.p_cx1 * peak_x)
    pure_x = peak_x * load * math.sin(_magic_angle(stiffness_x * (p.p_hx1 - slip), p.p_cx1, p.p_ex1) + load * p.p_vx1)
    stiffness_y = p.p_ky1 / (p.p_cy1 * friction)
    pure_y = friction * load * math.sin(_magic_angle(stiffness_y * slip_angle, p.p_cy1, p.p_ey1))

    # Combined slip: each force times a cosine magic formula of the other slip, 1 where that is 0.
    # 1 / sqrt(1 + x^2) is cos(arctan x).
    slope = p.r_bx1 / math.sqrt(1.0 + (p.r_bx2 * slip) ** 2)
    force_x = (
        pure_x
        * math.cos(_magic_angle(slope * (slip_angle + p.r_hx1), p.r_cx1, p.r_ex1))
        / math.cos(_magic_angle(slope * p.r_hx1, p.r_cx1, p.r_ex1))
    )
    slope = p.r_by1 / math.sqrt(1.0 + (p.r_by2 * (slip_angle - p.r_by3)) ** 2)
    side_force = (
        friction
        * load
        * p.r_vy1
        / math.sqrt(1.0 + (p.r_vy4 * slip_angle) ** 2)
        * math.sin(p.r_vy5 * math.atan(p.r_vy6 * slip))
    )
    force_y = (
        pure_y
        * math.cos(_magic_angle(slope * (slip + p.r_hy1), p.r_cy1, p.r_ey1))
        / math.cos(_magic_angle(slope * p.r_hy1, p.r_cy1, p.r_ey1))
        + side_force
    )
    return force_x, force_y
