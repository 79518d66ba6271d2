"""On the car: any scanner, sensors that fail, and nothing but NumPy and onnxruntime."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from outlap.deploy.car_driver import FORMAT, METADATA, CarDriver, Command, Limits

BEAMS, VIEW = 61, 4.7
FACTS = {
    "format": FORMAT, "terms": ["scan", "vel", "heading", "previous_reward"], "beams": BEAMS, "field_of_view": VIEW,
    "max_range": 30.0, "interval_s": 0.04, "speeds": [0.0, 8.0], "steering": [-0.4, 0.4],
    "reward": {"progress": 0.1, "steering_change": 0.5},
}  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that steers by the middle beam's range, drives at the yaw rate, and tells the last reward as action."""
    import json

    inputs = {"state": 2, "scan": BEAMS, "vel": 3, "heading": 2, "previous_reward": 1}
    outputs = {"command": 2, "action": 2, "next_state": 2}

    def number(name: str, value: int) -> Any:
        return helper.make_tensor(name, TensorProto.INT64, [1], [value])

    nodes = [
        helper.make_node("Gather", ["scan", "middle"], ["ahead"]),
        helper.make_node("Gather", ["vel", "last"], ["turn"]),
        helper.make_node("Concat", ["ahead", "turn"], ["command"], axis=0),
        helper.make_node("Concat", ["previous_reward", "previous_reward"], ["action"], axis=0),
        helper.make_node("Add", ["state", "state_step"], ["next_state"]),
    ]
    graph = helper.make_graph(
        nodes,
        "toy",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [size]) for name, size in inputs.items()],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [size]) for name, size in outputs.items()],
        [
            number("middle", BEAMS // 2),
            number("last", 2),
            helper.make_tensor("state_step", TensorProto.FLOAT, [2], [1.0, 1.0]),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 10
    helper.set_model_props(model, {METADATA: json.dumps(FACTS)})
    path = tmp_path_factory.mktemp("car") / "toy.onnx"
    onnx.save(model, path)
    return path


@pytest.fixture
def driver(path: Path) -> CarDriver:
    return CarDriver(path)


def corridor(angles: np.ndarray) -> np.ndarray:
    """Ranges in a corridor two metres wide that ends six metres ahead and four behind."""
    with np.errstate(divide="ignore"):
        sides = 1.0 / np.abs(np.sin(angles))
        ends = np.where(np.cos(angles) > 0, 6.0, 4.0) / np.abs(np.cos(angles))
    return np.minimum(sides, ends)


OWN = np.linspace(-0.5, 0.5, BEAMS) * VIEW
SCANNERS = {
    "its own": (-VIEW / 2, VIEW / (BEAMS - 1), BEAMS),
    "Hokuyo UST-10LX": (-0.75 * math.pi, math.radians(0.25), 1081),
    "coarse": (-VIEW / 2, VIEW / 45, 46),
    "clockwise": (VIEW / 2, -VIEW / 400, 401),
    "all round, from behind": (-math.pi, math.radians(0.5), 720),
    "all round, from ahead": (0.0, math.radians(0.5), 720),
}


@pytest.mark.parametrize("name", SCANNERS)
def test_any_scanner_is_read_as_the_policys_own(driver: CarDriver, name: str):
    angle_min, increment, count = SCANNERS[name]
    angles = angle_min + increment * np.arange(count)
    scan, unknown = driver.resample(corridor(angles), angle_min, increment)
    assert not unknown.any()
    away = np.abs(np.angle(np.exp(1j * (angles[:, None] - OWN)))).min(axis=0)
    near = corridor(OWN[:, None] + np.linspace(-1, 1, 41) * (away[:, None] + 1e-6))
    assert (scan >= near.min(axis=1) - 1e-3).all()
    assert (scan <= near.max(axis=1) + 1e-3).all()
    if name == "its own":
        np.testing.assert_allclose(scan, corridor(OWN), rtol=1e-5)


def test_far_and_missing_returns(driver: CarDriver):
    ranges = corridor(OWN).astype(np.float32)
    ranges[3] = np.inf  # nothing within reach
    ranges[10] = np.nan  # not known: its neighbour's
    ranges[20] = 0.0  # as some scanners say the same
    scan, unknown = driver.resample(ranges, OWN[0], OWN[1] - OWN[0])
    assert scan[3] == driver.max_range
    assert scan[10] in (scan[9], scan[11])
    assert scan[20] in (scan[19], scan[21])
    assert np.isfinite(scan).all()
    assert np.flatnonzero(unknown).tolist() == [10, 20]  # the beams are further apart than a neighbour may be


def test_a_narrow_scanner_leaves_beams_unknown(driver: CarDriver):
    angles = np.linspace(-1.0, 1.0, 200)
    _, unknown = driver.resample(corridor(angles), -1.0, angles[1] - angles[0])
    np.testing.assert_array_equal(unknown, np.abs(OWN) > 1.0 + math.radians(3.0))


@pytest.mark.parametrize("apart", [4.0, 8.0, 20.0, 90.0])
def test_a_return_is_believed_for_three_degrees_however_coarse_the_scanner(driver: CarDriver, apart: float):
    angles = np.arange(-180.0, 180.0, apart)
    _, unknown = driver.resample(np.full(len(angles), 3.0), -math.pi, math.radians(apart))
    away = np.abs((np.degrees(OWN)[:, None] - angles + 180.0) % 360.0 - 180.0).min(axis=1)
    np.testing.assert_array_equal(unknown, away > 3.0)
    command = driver.drive(np.full(len(angles), 3.0), -math.pi, math.radians(apart), (3.0, 0.1, 0.5))
    assert bool(command.reason) == (apart > 12.0)


@pytest.mark.parametrize("count", [720, 721, 722])
def test_a_whole_turn_is_no_more_than_a_turn(driver: CarDriver, count: int):
    increment = float(np.float32(2.0 * math.pi / 720))
    assert driver.drive(np.full(count, 3.0), 0.0, increment, (3.0, 0.1, 0.5)).reason == ""


GOOD: dict[str, Any] = {
    "ranges": corridor(OWN), "angle_min": float(OWN[0]), "angle_increment": float(OWN[1] - OWN[0]),
    "velocity": (3.0, 0.1, 0.5),
}  # fmt: skip


def test_it_drives_on_good_input(driver: CarDriver):
    command = driver.drive(**GOOD)
    assert command.reason == ""
    assert (command.steering_angle, command.speed) == pytest.approx((6.0, 0.5))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"scan_age": 0.5}, "scan is 0.50 s old; must be 0.2 s or less"),
        ({"odometry_age": math.nan}, "odometry is nan s old"),
        ({"scan_age": -1.0}, "scan is -1.00 s old"),
        ({"ranges": np.zeros(0)}, "scan: 100% of the policy's 61 beams are not known"),
        ({"ranges": np.full(BEAMS, np.nan)}, "scan: 100%"),
        ({"angle_increment": 0.0}, "scan: 100%"),
        ({"angle_min": math.nan}, "scan: 100%"),
        ({"ranges": np.full(1081, 3.0), "angle_min": -135.0, "angle_increment": 0.25}, "are its angles in degrees?"),
        ({"ranges": np.full(1081, 3.0), "angle_min": 0.0, "angle_increment": -0.25}, "spans 270 rad, more than a turn"),
        ({"angle_min": -135.0}, "scan begins at -135 rad, more than a turn"),
        ({"ranges": np.full(4, 3.0), "angle_min": -math.pi, "angle_increment": math.pi / 2}, "beams are not known"),
        ({"ranges": np.where(np.abs(OWN) < 0.6, 0.0, 2.0)}, "scan: 100% of the policy's 13 beams ahead are not known"),
        ({"ranges": np.full(BEAMS, np.inf)}, "scan: nothing within 30 m in any direction"),
        ({"ranges": 1000.0 * corridor(OWN)}, "scan: nothing within 30 m"),
        ({"ranges": np.where(np.arange(BEAMS) % 3 == 0, 2.0, np.nan)}, "beams are not known"),
        ({"velocity": (math.nan, 0.0, 0.0)}, "must be three finite numbers"),
        ({"velocity": (3.0, 0.0)}, "must be three finite numbers"),
        ({"velocity": (50.0, 0.0, 0.0)}, "odometry: 50.0 m/s; at most 12.0 is believed"),
        ({"velocity": (3.0, 0.0, 40.0)}, "odometry: turns at 40.0 rad/s"),
        ({"steering_angle": math.inf}, "steering angle is inf"),
        ({"steering_angle": math.nan}, "steering angle is nan"),
        ({"steering_angle": 57.0}, "steering angle is 57 rad; at most 0.6 is believed"),
        ({"steering_angle": -1e300}, "steering angle is -1e+300 rad"),
    ],
)
def test_absurd_and_stale_input_stops_the_car_and_says_why(driver: CarDriver, changes: dict[str, Any], said: str):
    before = driver.drive(**GOOD)
    stopped = driver.drive(**{**GOOD, **changes})
    assert said in stopped.reason
    assert stopped.speed == 0.0
    assert stopped.steering_angle == before.steering_angle  # no jerk
    again = driver.drive(**GOOD)
    assert again == before
    assert driver._state.tolist() == [1.0, 1.0]  # what was before is forgotten


@pytest.mark.parametrize("what", ["command", "action", "memory"])
def test_a_policy_that_is_not_finite_stops_the_car_and_begins_anew(
    driver: CarDriver, monkeypatch: pytest.MonkeyPatch, what: str
):
    before = driver.drive(**GOOD)
    with monkeypatch.context() as broken:
        if what == "command":
            broken.setattr(driver, "act", lambda observation: np.array([0.1, np.nan], np.float32))
        elif what == "action":
            driver._actions[1] = np.nan  # which the toy's reward, and so its action, follow
        else:
            driver._state[:] = np.inf
        stopped = driver.drive(**GOOD)
    assert stopped == Command(before.steering_angle, 0.0, "policy: its command or its memory is not finite")
    assert driver.drive(**GOOD) == before
    assert driver._state.tolist() == [1.0, 1.0]


def test_limits_are_ones_own(path: Path):
    patient = CarDriver(path, Limits(stale_after=2.0, sharpest=3.0))
    assert patient.drive(**GOOD, scan_age=1.0, steering_angle=1.1).reason == ""
    assert "at most 1.2 is believed" in patient.drive(**GOOD, steering_angle=1.3).reason


def test_the_reward_is_what_training_would_have_paid(driver: CarDriver):
    driver.drive(**GOOD)
    assert driver.action.tolist() == [0.0, 0.0]  # at the begin nothing was done yet
    driver._actions = np.array([[0.2, 0.0], [0.5, 0.0]], np.float32)
    driver.drive(**GOOD)
    # 0.1 a metre over 0.04 s at 3 m/s, less 0.5 times the change of steering
    assert driver.action[0] == pytest.approx(0.1 * 3.0 * 0.04 - 0.5 * 0.3, abs=1e-6)


def test_the_car_needs_numpy_and_onnxruntime_alone(path: Path):
    code = f"""
import sys
for name in ("torch", "gymnasium", "numba", "scipy", "stable_baselines3", "pandas", "pydantic", "matplotlib", "onnx"):
    sys.modules[name] = None
from outlap.deploy import CarDriver
import numpy as np
driver = CarDriver({str(path)!r})
print(driver.drive(np.full(61, 2.0), -2.35, 4.7 / 60, (1.0, 0.0, 0.25)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "Command(steering_angle=2.0, speed=0.25, reason='')" in result.stdout, result.stderr


class _Stub(types.ModuleType):
    """A ROS package of which anything can be imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *args, **kwargs: None})


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of the ROS 2 node, without ROS."""
    for name in ("rclpy", "rclpy.node", "rclpy.qos", "sensor_msgs.msg", "nav_msgs.msg", "ackermann_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, _Stub(name))
    file = Path(__file__).parents[2] / "examples" / "ros2" / "outlap_driver.py"
    spec = importlib.util.spec_from_file_location("outlap_driver", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def heard(loop: Any) -> Any:
    """The node's loop, to which a scan and odometry came at 99.95 s."""
    stamp = types.SimpleNamespace(sec=99, nanosec=950_000_000)
    header = types.SimpleNamespace(stamp=stamp)
    scan = types.SimpleNamespace(
        header=header, ranges=GOOD["ranges"].tolist(), angle_min=GOOD["angle_min"],
        angle_increment=GOOD["angle_increment"],
    )  # fmt: skip
    vector = types.SimpleNamespace
    twist = vector(twist=vector(linear=vector(x=3.0, y=0.1), angular=vector(z=0.5)))
    loop.scan, loop.odometry = scan, types.SimpleNamespace(header=header, twist=twist)
    return loop


def test_the_ros_node_passes_on_what_the_driver_says(node: Any, driver: CarDriver):
    now = 100.0
    loop = node.Loop(driver, speed_limit=3.0)
    assert "no scan yet" in loop.command(now).reason
    command = heard(loop).command(now)
    assert (command.steering_angle, command.speed, command.reason) == (pytest.approx(6.0), pytest.approx(0.5), "")
    assert "scan is 0.55 s old" in loop.command(now + 0.5).reason
    assert "scan is -0.45 s old" in loop.command(now - 0.5).reason  # the clock went back


def test_the_ros_node_keeps_to_its_speed_limit_and_stops_at_nan(node: Any):
    for steering, speed, published in (
        (0.1, 5.0, Command(0.1, 2.0)),
        (0.1, -5.0, Command(0.1, -2.0)),
        (0.1, 1.0, Command(0.1, 1.0)),
        (0.1, math.nan, Command(0.0, 0.0, "the command is 0.1 rad, nan m/s")),
        (math.inf, 1.0, Command(0.0, 0.0, "the command is inf rad, 1.0 m/s")),
    ):
        said = Command(steering, speed)
        driver = types.SimpleNamespace(drive=lambda *_, said=said, **__: said)
        assert heard(node.Loop(driver, speed_limit=2.0)).command(100.0) == published
    for limit in (-2.0, math.nan):  # a negative one would drive at its amount, and not even stop
        with pytest.raises(ValueError, match=f"speed_limit is {limit}"):
            node.Loop(None, speed_limit=limit)
