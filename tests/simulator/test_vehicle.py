"""The parameter record: fields, bounds, presets, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from outlap.config import load_config, save_config
from outlap.errors import OutlapError
from outlap.simulator.vehicle import (
    DERIVED,
    N_PARAMS,
    NAMES,
    PARAMETERS,
    PRESETS,
    ActuatorParams,
    AxleTyres,
    LidarParams,
    PacejkaTyre,
    SensorParams,
    VehicleParams,
    parameter_bounds,
    to_records,
    to_values,
)


def field_order() -> list[str]:
    names = [name for name in VehicleParams.model_fields if name not in ("axles", "tyre")]
    for config in (AxleTyres, PacejkaTyre, ActuatorParams, SensorParams, LidarParams):
        names += config.model_fields
    return names


def test_columns_follow_the_fields():
    assert PARAMETERS.names == (*field_order(), *DERIVED)
    assert all(PARAMETERS[name] == np.float32 for name in NAMES)
    values = np.arange(6 * N_PARAMS, dtype=np.float32).reshape(2, 3, N_PARAMS)
    params = to_records(values)
    for number, name in enumerate(NAMES):
        np.testing.assert_array_equal(params[name], values[..., number])
    np.testing.assert_array_equal(to_values(params), values)


def test_bounds_put_every_value_in_its_own_column():
    numbers = {name: 0.1 + 0.001 * number for number, name in enumerate(field_order())}
    for name in ("steer_min", "v_min", "p_ky1"):
        numbers[name] *= -1
    ranges = {name: tuple(sorted((value, 1.5 * value))) for name, value in numbers.items()}

    def pick(config, **nested):
        return config(**{name: ranges[name] for name in config.model_fields if name in ranges}, **nested)

    vehicle = pick(VehicleParams, axles=pick(AxleTyres), tyre=pick(PacejkaTyre))
    low, high = parameter_bounds(vehicle, pick(ActuatorParams), pick(LidarParams), pick(SensorParams))
    assert low.shape == high.shape == (N_PARAMS,)
    assert low.dtype == high.dtype == np.float32
    for number, name in enumerate(field_order()):
        np.testing.assert_allclose((low[number], high[number]), ranges[name], rtol=1e-6)


def test_fixed_values_have_equal_bounds():
    for preset in PRESETS.values():
        low, high = parameter_bounds(preset)
        np.testing.assert_array_equal(low, high)
        assert np.all(np.isfinite(low))


def test_presets_are_the_published_cars():
    gym, paper = PRESETS["f1tenth"], PRESETS["paper"]
    assert (gym.mu, gym.C_Sf, gym.C_Sr, gym.lf, gym.lr) == (1.0489, 4.718, 5.4562, 0.15875, 0.17145)
    assert (gym.h, gym.m, gym.I, gym.width, gym.length) == (0.074, 3.74, 0.04712, 0.31, 0.58)
    assert (gym.steer_min, gym.steer_max, gym.steer_rate_max) == (-0.4189, 0.4189, 3.2)
    assert (gym.v_switch, gym.a_max, gym.v_min, gym.v_max) == (7.319, 9.51, -5.0, 20.0)
    changed = {"mu": 0.8, "a_max": 6.34, "v_min": -8.0, "v_max": 8.0, "motor_force": 23.71, "motor_power": 173.5}
    assert paper == gym.model_copy(update=changed)


@pytest.mark.parametrize("preset", ["f1tenth", "paper"])
def test_the_forces_of_a_preset_give_its_accelerations(preset):
    """F = m a_max and P = F v_switch: the same car under every model."""
    car = to_records(parameter_bounds(PRESETS[preset])[0])
    assert car["motor_force"] == pytest.approx(car["m"] * car["a_max"], rel=1e-3)
    assert car["motor_power"] == pytest.approx(car["motor_force"] * car["v_switch"], rel=1e-3)


def test_the_default_axles_have_the_cornering_stiffness_of_the_other_models():
    """B C = C_S: load and friction are the same factors."""
    car = to_records(parameter_bounds(VehicleParams())[0])
    assert car["front_B"] * car["front_C"] == pytest.approx(car["C_Sf"], rel=1e-4)
    assert car["rear_B"] * car["rear_C"] == pytest.approx(car["C_Sr"], rel=1e-4)


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        (VehicleParams, "m", 0.0),
        (VehicleParams, "m", -3.74),
        (VehicleParams, "m", 1e-300),
        (VehicleParams, "mu", 1e300),
        (VehicleParams, "lr", (1e-5, 0.2)),
        (VehicleParams, "width", 1e-6),
        (VehicleParams, "steer_max", 1e-6),
        (VehicleParams, "v_max", 1e5),
        (PacejkaTyre, "r_bx1", -1e30),
        (ActuatorParams, "steer_gain", 1e30),
        (LidarParams, "mount_x", 1e30),
        (LidarParams, "bias", -1e39),
        (VehicleParams, "mu", (0.0, 1.0)),
        (VehicleParams, "mu", (1.0, 0.5)),
        (VehicleParams, "mu", float("nan")),
        (VehicleParams, "I", float("inf")),
        (VehicleParams, "lf", (0.1, float("inf"))),
        (VehicleParams, "h", -0.01),
        (VehicleParams, "steer_min", 0.0),
        (VehicleParams, "steer_min", 0.4),
        (VehicleParams, "steer_max", -0.4),
        (VehicleParams, "steer_max", 1.6),
        (VehicleParams, "v_min", 1.0),
        (VehicleParams, "v_max", 0.0),
        (VehicleParams, "brake_split", 1.1),
        (VehicleParams, "colour", "red"),
        (AxleTyres, "front_C", 2.0),
        (AxleTyres, "rear_E", 2.1),
        (AxleTyres, "rear_peak", 0.0),
        (VehicleParams, "motor_force", 0.0),
        (VehicleParams, "brake_force", -1.0),
        (ActuatorParams, "grip_share", 1.01),
        (ActuatorParams, "steer_ratio", 0.0),
        (SensorParams, "speed_noise", -0.1),
        (SensorParams, "speed_scale", 0.0),
        (LidarParams, "latency", -0.01),
        (PacejkaTyre, "p_ky1", 21.92),
        (PacejkaTyre, "p_cy1", 0.0),
        (ActuatorParams, "steer_gain", 0.0),
        (ActuatorParams, "steer_delay", -0.01),
        (ActuatorParams, "speed_lag", (-0.1, 0.1)),
        (LidarParams, "dropout", 1.5),
        (LidarParams, "dropout", (-0.1, 0.5)),
        (LidarParams, "max_range", 0.0),
        (LidarParams, "noise_std", -0.1),
    ],
)
def test_impossible_values_are_refused(config, field, value):
    with pytest.raises(ValidationError) as error:
        config(**{field: value})
    assert error.value.errors()[0]["loc"][0] == field


def test_a_car_survives_a_file(tmp_path):
    car = VehicleParams(mu=(0.5, 1.1), m=4.0, tyre=PacejkaTyre(p_dy1=0.9))
    assert load_config(VehicleParams, save_config(car, tmp_path / "car.yaml")) == car


def test_a_wrong_file_says_where_and_why(tmp_path):
    path = tmp_path / "car.yaml"
    path.write_text("mu: -1\n")
    with pytest.raises(OutlapError, match=r"car\.yaml: mu .*>= 0\.01"):
        load_config(VehicleParams, path)
