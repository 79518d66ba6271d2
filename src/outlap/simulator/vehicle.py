"""The parameters of a car: configuration models with units, ranges and presets, and the record that kernels read.

Every numeric field of a model is a `Number`: a value, or a range (min, max) from which each reset samples.
A car of the simulator is one record of the dtype `PARAMETERS`, which has a float32 field for each of them:
kernels read `p.mu`, Python reads `params["mu"]`. A new field of a model is a new field of the records.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated

import numpy as np

from outlap.config import Config, Number, bounded, bounds, widest

# What a `Number` of a car may be: from a toy to a lorry. Beyond, single precision or the integrator gives way.
Friction = Annotated[Number, bounded(at_least=0.01, at_most=10)]  # [-]
Stiffness = Annotated[Number, bounded(at_least=0.01, at_most=1000)]  # [1/rad], or [-] of longitudinal slip
OpposingStiffness = Annotated[Number, bounded(at_least=-1000, at_most=-0.01)]
Shape = Annotated[Number, bounded(at_least=0.01, at_most=10)]  # [-]
Coefficient = Annotated[Number, bounded(at_least=-1000, at_most=1000)]
Distance = Annotated[Number, bounded(at_least=0.01, at_most=20)]  # [m]
Height = Annotated[Number, bounded(at_least=0, at_most=20)]  # [m]
Place = Annotated[Number, bounded(at_least=-20, at_most=20)]  # [m]
Mass = Annotated[Number, bounded(at_least=0.01, at_most=1e5)]  # [kg]
Inertia = Annotated[Number, bounded(at_least=1e-6, at_most=1e6)]  # [kg m^2]
Rate = Annotated[Number, bounded(at_least=0.01, at_most=1000)]  # [rad/s] or [m/s^2]
Speed = Annotated[Number, bounded(at_least=0.01, at_most=200)]  # [m/s]
ReverseSpeed = Annotated[Number, bounded(at_least=-200, at_most=0)]  # [m/s]
LeftAngle = Annotated[Number, bounded(at_least=0.01, below=1.5)]  # [rad]
RightAngle = Annotated[Number, bounded(above=-1.5, at_most=-0.01)]
Gain = Annotated[Number, bounded(at_least=0.01, at_most=1e9)]
ForceGain = Annotated[Number, bounded(at_least=0.01, at_most=1e6)]  # [N s/m]
Force = Annotated[Number, bounded(at_least=0.01, at_most=1e6)]  # [N]
Power = Annotated[Number, bounded(at_least=0.01, at_most=1e8)]  # [W]
Ramp = Annotated[Number, bounded(at_least=0, at_most=1000)]  # [m/s^2]; 0 = none
SmallAngle = Annotated[Number, bounded(at_least=-0.5, at_most=0.5)]  # [rad]
Ratio = Annotated[Number, bounded(at_least=0.1, at_most=10)]  # [-]
FallingShape = Annotated[Number, bounded(at_least=0.01, at_most=1.95)]  # [-] at 2 the force would vanish
Curvature = Annotated[Number, bounded(at_least=-20, at_most=2)]  # [-]
MeasuredSpeedError = Annotated[Number, bounded(at_least=0, at_most=100)]  # [m/s]
MeasuredRateError = Annotated[Number, bounded(at_least=-10, at_most=10)]  # [rad/s]
MeasuredRateDeviation = Annotated[Number, bounded(at_least=0, at_most=10)]  # [rad/s]
Duration = Annotated[Number, bounded(at_least=0, at_most=1000)]  # [s]
Range = Annotated[Number, bounded(at_least=0.01, at_most=1000)]  # [m]
RangeError = Annotated[Number, bounded(at_least=-1000, at_most=1000)]  # [m]
Deviation = Annotated[Number, bounded(at_least=0, at_most=1000)]  # [m]
Fraction = Annotated[Number, bounded(at_least=0, at_most=1)]


class PacejkaTyre(Config):
    """Magic Formula coefficients of the drift model, without camber.

    The default is the table of the CommonRoad vehicle models (Althoff and Würsching, 2020, table 7: an
    ADAMS passenger-car tyre). Its peaks are scaled by mu / p_dy1, so that `VehicleParams.mu` is the
    lateral friction in every model.
    """

    p_cx1: Shape = 1.6411  # longitudinal shape factor [-]
    p_dx1: Friction = 1.1739  # longitudinal friction [-]
    p_ex1: Coefficient = 0.46403  # longitudinal curvature [-]
    p_kx1: Stiffness = 22.303  # longitudinal slip stiffness / load [-]
    p_hx1: Coefficient = 0.0012297  # longitudinal horizontal shift [-]
    p_vx1: Coefficient = -8.8098e-06  # longitudinal vertical shift / load [1/N]
    r_bx1: Coefficient = 13.276  # combined longitudinal: slope [1/rad]
    r_bx2: Coefficient = -13.778  # combined longitudinal: slope's change with slip [-]
    r_cx1: Coefficient = 1.2568  # combined longitudinal: shape factor [-]
    r_ex1: Coefficient = 0.65225  # combined longitudinal: curvature [-]
    r_hx1: Coefficient = 0.0050722  # combined longitudinal: shift [rad]
    p_cy1: Shape = 1.3507  # lateral shape factor [-]
    p_dy1: Friction = 1.0489  # lateral friction [-]
    p_ey1: Coefficient = -0.0074722  # lateral curvature [-]
    p_ky1: OpposingStiffness = -21.92  # cornering stiffness / load [1/rad]
    r_by1: Coefficient = 7.1433  # combined lateral: slope [-]
    r_by2: Coefficient = 9.1916  # combined lateral: slope's change with slip angle [1/rad]
    r_by3: Coefficient = -0.027856  # combined lateral: shift of that change [rad]
    r_cy1: Coefficient = 1.0719  # combined lateral: shape factor [-]
    r_ey1: Coefficient = -0.27572  # combined lateral: curvature [-]
    r_hy1: Coefficient = 5.7448e-06  # combined lateral: shift [-]
    r_vy1: Coefficient = -0.027825  # side force from longitudinal slip / (mu load) [-]
    r_vy4: Coefficient = 12.12  # its change with slip angle [1/rad]
    r_vy5: Coefficient = 1.9  # its change with slip: shape [-]
    r_vy6: Coefficient = -10.704  # its change with slip: slope [-]


class AxleTyres(Config):
    """Magic Formula coefficients of the axles in the nonlinear single-track model.

    The lateral force of an axle is -mu peak F_z sin(C arctan(B a - E (B a - arctan(B a)))) / p, with the slip angle a
    and the largest value p of the sine up to a = pi / 2: `mu` times `peak` is the peak friction coefficient, also where
    C < 1 and the sine never reaches 1. Beyond its peak the force falls and keeps its sign, since C < 2. Where E > 1 the
    formula would fall through zero at large slip angles; there the force stays at its peak.

    The default stiffness at the origin is the F1TENTH gym's, B = C_S / C; the shape C is that of `PacejkaTyre`.
    """

    front_B: Stiffness = 3.4930  # stiffness factor [1/rad]
    front_C: FallingShape = 1.3507  # shape factor [-]
    front_E: Curvature = 0.0  # curvature factor [-]
    front_peak: Shape = 1.0  # peak friction of the axle / mu [-]
    rear_B: Stiffness = 4.0395  # [1/rad]
    rear_C: FallingShape = 1.3507  # [-]
    rear_E: Curvature = 0.0  # [-]
    rear_peak: Shape = 1.0  # [-]


class VehicleParams(Config):
    """A car. The default is the F1TENTH gym's 1:10 car.

    The wheels' radius and inertia, which only the drift model reads, are those of a 1:10 all-wheel-drive
    chassis: 0.1 m wheels of about 0.12 kg, two an axle, plus the motor's rotor through the gearbox.

    `nonlinear_single_track` takes motor and brakes as forces; the default ones give the car of the default mass `a_max`
    and `v_switch`, by which the other models go.
    """

    mu: Friction = 1.0489  # tyre-road friction [-]
    C_Sf: Stiffness = 4.718  # cornering stiffness / (mu load), front [1/rad]
    C_Sr: Stiffness = 5.4562  # cornering stiffness / (mu load), rear [1/rad]
    lf: Distance = 0.15875  # centre of gravity to front axle [m]
    lr: Distance = 0.17145  # centre of gravity to rear axle [m]
    h: Height = 0.074  # height of the centre of gravity [m]
    m: Mass = 3.74  # mass [kg]
    I: Inertia = 0.04712  # noqa: E741
    """yaw inertia [kg m^2]"""
    width: Distance = 0.31  # of the body [m]
    length: Distance = 0.58  # of the body [m]
    steer_min: RightAngle = -0.4189  # right stop [rad]
    steer_max: LeftAngle = 0.4189  # left stop [rad]
    steer_rate_max: Rate = 3.2  # either way [rad/s]
    a_max: Rate = 9.51  # either way [m/s^2]
    v_switch: Speed = 7.319  # above it, power limits acceleration to a_max v_switch / v [m/s]
    motor_force: Force = 35.57  # largest driving force [N]
    motor_power: Power = 260.3  # largest power of the motor [W]
    brake_force: Force = 35.57  # largest braking force [N]
    v_min: ReverseSpeed = -5.0  # fastest reverse [m/s]
    v_max: Speed = 20.0  # fastest forward [m/s]
    wheel_radius: Distance = 0.0508  # [m]
    wheel_inertia: Inertia = 6e-4  # of an axle about its spin, with its share of the drive train [kg m^2]
    brake_split: Fraction = 0.5  # front share of the braking torque [-]
    engine_split: Fraction = 0.5  # front share of the driving torque [-]
    axles: AxleTyres = AxleTyres()  # of the nonlinear single-track model
    tyre: PacejkaTyre = PacejkaTyre()  # of the drift model


class ActuatorParams(Config):
    """How commands (steering angle, speed) become a steering rate and an acceleration.

    `nonlinear_single_track` follows the speed with a force of `force_gain` times the error; all other models with the
    F1TENTH gym's controller and `speed_gain`.
    """

    steer_trim: SmallAngle = 0.0  # steering angle at the command 0 [rad]
    steer_ratio: Ratio = 1.0  # steering angle / commanded angle [-]
    steer_gain: Gain = 1e6  # steering rate / angle error; 1 / step or more is bang-bang [1/s]
    steer_delay: Duration = 0.0  # rounded to physics steps [s]
    steer_lag: Duration = 0.0  # time constant of a first-order lag; 0 = none [s]
    speed_gain: Gain = 10.0  # the F1TENTH gym's: acceleration = gain a_max / v_max, speed error [-]
    speed_delay: Duration = 0.0  # rounded to physics steps [s]
    speed_lag: Duration = 0.0  # time constant of a first-order lag; 0 = none [s]
    speed_ramp_up: Ramp = 0.0  # largest growth of the commanded speed; 0 = none [m/s^2]
    speed_ramp_down: Ramp = 0.0  # largest fall of the commanded speed; 0 = none [m/s^2]
    force_gain: ForceGain = 6.7  # force / speed error [N s/m]
    grip_share: Fraction = 1.0  # of an axle's grip for drive and brakes; 1 = wheels may lock, less = anti-lock [-]


class SensorParams(Config):
    """Errors of the measured motion, which a policy observes. Rewards and results use the true motion."""

    speed_scale: Ratio = 1.0  # measured / true velocity [-]
    speed_noise: MeasuredSpeedError = 0.0  # standard deviation of the measured velocity [m/s]
    yaw_rate_bias: MeasuredRateError = 0.0  # added to the measured yaw rate [rad/s]
    yaw_rate_noise: MeasuredRateDeviation = 0.0  # standard deviation of the measured yaw rate [rad/s]


class LidarParams(Config):
    """Where the scanner sits and what is wrong with its ranges."""

    mount_x: Place = 0.0  # in front of the centre of gravity [m]
    mount_y: Place = 0.0  # to the left of it [m]
    mount_yaw: SmallAngle = 0.0  # heading of the scanner's x axis in the car's frame [rad]
    latency: Duration = 0.0  # age of the poses that a scan shows, rounded to physics steps [s]
    max_range: Range = 30.0  # [m]
    noise_std: Deviation = 0.0  # Gaussian, independent per beam [m]
    bias: RangeError = 0.0  # added to every range [m]
    dropout: Fraction = 0.0  # probability that a beam reads max_range [-]


PRESETS: dict[str, VehicleParams] = {
    "f1tenth": VehicleParams(),
    "paper": VehicleParams(mu=0.8, a_max=6.34, v_min=-8.0, v_max=8.0, motor_force=23.71, motor_power=173.5),
    # Identified on a real car by the ForzaETH race stack (Baumann et al., 2024): B, C, D, E front 5.5405, 0.4182,
    # 1.8635, 0.3722, rear 6.6014, 0.5624, 1.7327, 1.0648. D sin(C arctan(...)) peaks at 1.0335 in front and at 0.8024
    # behind.
    "forzaeth": VehicleParams(
        mu=1.0335, m=3.54, I=0.05797, lf=0.162, lr=0.145, h=0.014, v_max=10.0,
        axles=AxleTyres(
            front_B=5.5405, front_C=0.4182, front_E=0.3722, front_peak=1.0,
            rear_B=6.6014, rear_C=0.5624, rear_E=1.0648, rear_peak=0.7764,
        ),
    ),
}  # fmt: skip


# The models that make up a car, each with the prefix of its parameters in results.
_MODELS: tuple[tuple[str, type[Config]], ...] = (
    ("vehicle", VehicleParams),
    ("vehicle_axles", AxleTyres),
    ("vehicle_tyre", PacejkaTyre),
    ("actuators", ActuatorParams),
    ("sensors", SensorParams),
    ("lidar", LidarParams),
)
_FIELDS = [
    (prefix, model, name)
    for prefix, model in _MODELS
    for name, field in model.model_fields.items()
    if not isinstance(field.default, Config)
]

DERIVED = {"kinematic_speed": 0.0, "front_scale": 0.0, "rear_scale": 0.0, "road_friction": 1.0}
"""What the simulator derives, with its value before that.

At each reset: `kinematic_speed` [m/s] of `dynamics.kinematic_speed`, and the factors of `nonlinear.axle_scale` [-]. At
each step: `road_friction` [-], the share of `mu` that the road gives where the car is.
"""

NAMES = (*(name for _, _, name in _FIELDS), *DERIVED)
"""A car's parameters: the numbers of its models in the order of their fields, then the derived ones."""

N_PARAMS = len(NAMES)

PARAMETERS = np.dtype([(name, np.float32) for name in NAMES], align=True)
"""A car's parameters as a record, without padding."""


def to_records(values: np.ndarray) -> np.ndarray:
    """Return rows of numbers, (..., N_PARAMS), as records of `PARAMETERS`, (...); a view where they are float32."""
    return np.ascontiguousarray(values, np.float32).view(PARAMETERS)[..., 0]


def to_values(params: np.ndarray) -> np.ndarray:
    """Return records of `PARAMETERS`, (...), as float32 rows, (..., N_PARAMS); a view where they are contiguous."""
    return np.ascontiguousarray(params)[..., None].view(np.float32).reshape(*params.shape, N_PARAMS)


def parameter_bounds(
    vehicle: VehicleParams,
    actuators: ActuatorParams | None = None,
    lidar: LidarParams | None = None,
    sensors: SensorParams | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value of each parameter of a configuration.

    Args:
        vehicle: the car.
        actuators: its actuators; none gives the default ones.
        lidar: its scanner; none gives the default one.
        sensors: its other sensors; none gives perfect ones.

    Returns:
        low, high: float32 (N_PARAMS,) each, equal where a value is fixed. Sample uniformly between them and pass the
        rows to `to_records`. Derived parameters have their values of `DERIVED`.
    """
    parts = {
        VehicleParams: vehicle,
        AxleTyres: vehicle.axles,
        PacejkaTyre: vehicle.tyre,
        ActuatorParams: actuators or ActuatorParams(),
        SensorParams: sensors or SensorParams(),
        LidarParams: lidar or LidarParams(),
    }
    ends = [bounds(getattr(parts[model], name)) for _, model, name in _FIELDS]
    low, high = np.array([*ends, *((value, value) for value in DERIVED.values())], np.float32).T.copy()
    return low, high


@cache
def accepted_bounds() -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value that any configuration accepts: float32 (N_PARAMS,) each.

    `v_max` may also be 0: an opponent that stands still.
    """
    ends = [widest(model, name) for _, model, name in _FIELDS]
    low, high = np.array([*ends, *((0.0, np.finfo(np.float32).max) for _ in DERIVED)], np.float32).T.copy()
    low[NAMES.index("v_max")] = 0.0
    return low, high


def parameter_names() -> list[str]:
    """Return the name of each parameter in results: `vehicle_mu`, `lidar_noise_std`."""
    return [f"{prefix}_{name}" for prefix, _, name in _FIELDS] + list(DERIVED)
