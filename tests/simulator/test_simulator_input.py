"""What a simulator refuses: one line that names the argument, and nothing changed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.errors import OutlapError
from outlap.simulator.simulator import Simulator, SimulatorConfig
from outlap.simulator.vehicle import PARAMETERS, to_values
from synthetic_tracks import CAR, assert_same, ring, snapshot


def good() -> dict[str, np.ndarray]:
    """Arguments of a reset of two worlds of two cars."""
    return {
        "which": np.arange(2),
        "keys": np.arange(2, dtype=np.uint64),
        "tracks": np.zeros(2, int),
        "params": np.full((2, 2), CAR),
        "starts": np.zeros((2, 2, 4)),
    }


def changed(name: str, where, value) -> np.ndarray:
    array = good()[name]
    array[where] = value
    return array


def with_parameter(world: int, car: int, name: str, value: float) -> np.ndarray:
    params = good()["params"]
    params[name][world, car] = value
    return params


@pytest.fixture
def sim() -> Simulator:
    """Two worlds of two cars, ready to step."""
    sim = Simulator([ring()], 2, 2, SimulatorConfig(beams=4))
    arguments = good()
    sim.reset(arguments.pop("which"), **arguments)
    return sim


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("which", [0, 2]), ("which", [-1, 0]),
        ("keys", np.arange(1, dtype=np.uint64)), ("keys", np.zeros((2, 2), np.uint64)),
        ("tracks", [0]), ("tracks", [0, 1]), ("tracks", [-1, 0]),
        ("params", np.full(2, CAR)), ("params", np.full((2, 2), CAR)[["mu", "lf"]]), ("params", np.ones((2, 2))),
        ("params", to_values(np.full((2, 2), CAR))),
        ("params", with_parameter(1, 0, "lr", np.nan)), ("params", with_parameter(0, 1, "max_range", np.inf)),
        ("params", with_parameter(0, 1, "lr", 0.0)), ("params", np.zeros((2, 2), PARAMETERS)),
        ("params", with_parameter(0, 0, "max_range", 1e30)),
        ("params", with_parameter(0, 0, "steer_delay", 0.02)),
        ("params", with_parameter(0, 0, "speed_delay", 0.01)),
        ("params", with_parameter(0, 0, "steer_delay", np.nan)),
        ("starts", np.zeros((2, 4))), ("starts", np.zeros((2, 2, 3))),
        ("starts", changed("starts", (0, 1, 3), np.nan)), ("starts", changed("starts", (0, 0, 0), np.inf)),
    ],
)  # fmt: skip
def test_a_reset_with_bad_input_names_it_and_changes_nothing(sim, name, value):
    before = snapshot(sim)
    arguments = good() | {name: value}
    with pytest.raises(OutlapError, match=name) as caught:
        sim.reset(arguments.pop("which"), **arguments)
    assert "\n" not in str(caught.value)
    assert_same(before, snapshot(sim))


def test_a_reset_of_no_world_is_fine(sim):
    before = snapshot(sim)
    arguments = {name: value[:0] for name, value in good().items()}
    sim.reset(arguments.pop("which"), **arguments)
    assert_same(before, snapshot(sim))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, -1.1e6])
def test_commands_beyond_all_measure_are_refused_by_world_and_car(sim, value):
    before = snapshot(sim)
    commands = np.zeros((2, 2, 2))
    commands[1, 0, 1] = value
    with pytest.raises(OutlapError, match=r"commands.*car 0 in world 1"):
        sim.step(commands)
    assert_same(before, snapshot(sim))


@pytest.mark.parametrize("commands", [np.full((2, 2, 2), None), np.full((2, 2, 2), "1"), np.zeros((2, 2, 2), complex)])
def test_commands_that_are_no_numbers_are_refused(sim, commands):
    with pytest.raises(OutlapError, match=r"commands is of type .*; they must be numbers"):
        sim.step(commands)


@pytest.mark.parametrize("shape", [(2, 2), (2, 2, 3), (1, 2, 2), (2, 1, 2), (0,)])
def test_commands_of_another_shape_are_refused(sim, shape):
    with pytest.raises(OutlapError, match="commands has shape"):
        sim.step(np.zeros(shape))


@pytest.mark.parametrize("repeats", [0, -1])
def test_a_step_of_no_physics_steps_is_refused(sim, repeats):
    with pytest.raises(OutlapError, match="repeats"):
        sim.step(np.zeros((2, 2, 2)), repeats)


def test_a_world_that_was_never_reset_is_named():
    sim = Simulator([ring()], 3, 1, SimulatorConfig(beams=0))
    arguments = {name: value[:2, :1] if value.ndim > 1 else value for name, value in good().items()}
    sim.reset(arguments.pop("which"), **arguments)
    with pytest.raises(OutlapError, match="world 2 was never reset"):
        sim.step(np.zeros((3, 1, 2)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("timestep", 0.0), ("timestep", -0.01), ("timestep", 0.11), ("substeps", 0), ("beams", -1),
        ("beams", 1081), ("field_of_view", 0.0), ("field_of_view", 6.3),
    ],
)  # fmt: skip
def test_a_configuration_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        Simulator([ring()], 1, 1, SimulatorConfig(**{field: value}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tracks", []), ("num_worlds", 0), ("num_cars", 0), ("max_delay", 100.0), ("max_delay", -0.05),
        ("max_delay", math.nan), ("max_delay", math.inf),
    ],
)  # fmt: skip
def test_a_simulator_that_cannot_be_is_refused_by_name(name, value):
    arguments = {"tracks": [ring()], "num_worlds": 1, "num_cars": 1, "max_delay": 0.0} | {name: value}
    with pytest.raises(OutlapError, match=name):
        Simulator(**arguments)
