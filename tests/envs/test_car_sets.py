"""Sets of cars: what their names and files mean, what is refused, and that a car keeps its number and parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from outlap.drivers.classical import CenterlineFollower
from outlap.envs import car_sets
from outlap.envs.car_sets import TRAINING_RANGES, find_cars, is_test_split, scaled
from outlap.envs.keywords import make_race_vector
from outlap.envs.race_config import RaceConfig
from outlap.envs.tasks import NO_CAR
from outlap.envs.terminations import TerminationConfig
from outlap.errors import OutlapError
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import NAMES, accepted_bounds, to_records
from synthetic_tracks import ring

THREE = "# three cars\nmu,m,motor_force\n0.5,3.0,30\n\n0.75,3.5,35\n1.0,4.0,40\n"


@pytest.fixture
def three(tmp_path: Path) -> str:
    """A file of three cars."""
    path = tmp_path / "three.csv"
    path.write_text(THREE)
    return str(path)


def test_a_file_is_a_list_of_cars(three):
    cars = find_cars(three)
    assert (cars.parameters, cars.size, cars.listed) == (("mu", "m", "motor_force"), 3, True)
    np.testing.assert_allclose(cars.values, [[0.5, 3.0, 30.0], [0.75, 3.5, 35.0], [1.0, 4.0, 40.0]])
    np.testing.assert_allclose(cars.bounds, [[0.5, 3.0, 30.0], [1.0, 4.0, 40.0]])
    assert [NAMES[column] for column in cars.columns] == ["mu", "m", "motor_force"]
    assert not is_test_split(three)


def test_training_is_the_distribution_of_the_training_ranges():
    cars = find_cars("training")
    assert (cars.parameters, cars.size, cars.listed) == (tuple(TRAINING_RANGES), 0, False)
    low, high = cars.bounds
    np.testing.assert_allclose(scaled(low), -1.0, atol=1e-6)
    np.testing.assert_allclose(scaled(high), 1.0, atol=1e-6)
    for name, each in TRAINING_RANGES.items():
        column = NAMES.index(name)
        # Test cars lie up to 1.5 half ranges from the middle: what a configuration accepts is wider.
        accepted = [ends[column] for ends in accepted_bounds()]
        assert accepted[0] <= each.low < each.high <= accepted[1]
        assert each.difficult in (-1, 1)


def test_a_split_may_be_cut_to_its_first_cars(tmp_path, monkeypatch):
    (tmp_path / "cars").mkdir()
    (tmp_path / "cars" / "outside.csv").write_text(THREE)
    monkeypatch.setattr(car_sets.resources, "files", lambda _: tmp_path)
    assert find_cars("outside").size == 3
    two = find_cars("outside:2")
    assert (two.name, two.size) == ("outside:2", 2)
    np.testing.assert_array_equal(two.values, find_cars("outside").values[:2])
    assert is_test_split("outside:2")
    for name in ("outside:0", "outside:4", "outside:many", "outside:-1"):
        with pytest.raises(OutlapError, match="outside has 1 to 3 cars"):
            find_cars(name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must have a header"),
        ("mu,m\n", "must have a header of different parameters and a row for each car"),
        ("mu,mu\n1,1\n", "different parameters"),
        ("mu,colour\n1,1\n", "'colour' is not a parameter of a car"),
        ("mu,kinematic_speed\n1,1\n", "'kinematic_speed' is not a parameter"),
        ("mu,m\n1,3\n1\n", "every row must have 2 numbers"),
        ("mu,m\n1,heavy\n", "could not convert string to float: 'heavy'; every row must have 2 numbers"),
        ("mu,m\n1,3\n1,-3\n", r"m of car 1 is -3; must be in \[0\.01, 100000\]"),
        ("mu,m\n1,nan\n", "m of car 0 is nan; must be in"),
    ],
)
def test_a_file_that_holds_no_cars_says_where_and_why(tmp_path, text, said):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(OutlapError, match=f"bad.csv: .*{said}"):
        find_cars(str(path))


@pytest.mark.parametrize("name", ["everywhere", "cars.txt", "training:3", ""])
def test_an_unknown_set_names_those_there_are(name):
    with pytest.raises(OutlapError, match="must be training, one of inside, edge, outside, hard"):
        find_cars(name)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(OutlapError, match=r"none\.csv: cannot be read"):
        find_cars(str(tmp_path / "none.csv"))


def test_a_listed_car_keeps_its_number_and_parameters(ellipse, three):
    """In every episode and for every car of a race; each is as likely."""
    env = make_race_vector(
        60, tracks=[ellipse], num_cars=2, beams=0, cars=three, vehicle={"lf": (0.15, 0.17)},
        termination={"time_limit": 0.01},
    )  # fmt: skip
    _, info = env.reset(seed=0)
    values, numbers = find_cars(three).values, []
    for _ in range(10):
        vehicle, cars = to_records(info["vehicle"]), env.race.cars
        np.testing.assert_array_equal(info["car"], cars[:, 0])
        for column, name in enumerate(("mu", "m", "motor_force")):
            np.testing.assert_array_equal(vehicle[name], values[cars, column])
        assert len(np.unique(vehicle["lf"])) == 120  # other parameters are drawn as before
        numbers.append(cars.copy())
        *_, info = env.step(np.zeros((60, 2)))
        *_, info = env.step(np.zeros((60, 2)))
    assert stats.chisquare(np.bincount(np.ravel(numbers), minlength=3)).pvalue > 1e-4


def test_the_final_info_has_the_car_of_the_episode_that_ended(ellipse, three):
    env = make_race_vector(40, tracks=[ellipse], beams=0, cars=three, termination={"time_limit": 0.01})
    _, info = env.reset(seed=1)
    before = info["car"].copy()
    *_, info = env.step(np.zeros((40, 2)))
    ended = info.get("final_info", info)
    np.testing.assert_array_equal(ended["car"], before)


def test_without_a_list_a_car_has_no_number(ellipse):
    env = make_race_vector(20, tracks=[ellipse], beams=0, cars="training")
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["car"], NO_CAR)
    drawn = to_records(info["vehicle"])
    for name, each in TRAINING_RANGES.items():
        values = drawn[name][:, 0]
        assert np.float32(each.low) <= values.min() < values.max() <= np.float32(each.high)


def test_the_term_vehicle_is_the_scaled_parameters(ellipse):
    env = make_race_vector(50, tracks=[ellipse], beams=0, cars="training", observation="vehicle")
    observation, info = env.reset(seed=0)
    seen, drawn = observation["vehicle"], to_records(info["vehicle"])[:, 0]
    assert seen.shape == (50, len(TRAINING_RANGES))
    assert np.abs(seen).max() <= 1.0 + 1e-5
    for column, (name, each) in enumerate(TRAINING_RANGES.items()):
        expected = (2.0 * drawn[name] - each.low - each.high) / (each.high - each.low)
        np.testing.assert_allclose(seen[:, column], expected, atol=1e-5)


def test_every_row_of_an_evaluation_has_its_car(three):
    """And its parameters; also delays from a set have room in the simulator."""
    track = ring(radius=4.0, half_width=0.8)
    task = RaceConfig(
        beams=0, control_interval=8, model="nonlinear_single_track", cars=three, speed_range=(0.0, 2.0),
        termination=TerminationConfig(time_limit=0.5),
    )  # fmt: skip
    rows = evaluate(CenterlineFollower(speed_action=1.0), task, [track], 12, seed=0, lap_time_ratios=False)
    cars = rows["car"].to_numpy()
    assert set(cars) == {0, 1, 2}
    values = find_cars(three).values
    for column, name in enumerate(("vehicle_mu", "vehicle_m", "vehicle_motor_force")):
        np.testing.assert_allclose(rows[name], values[cars, column])
    alone = task.model_copy(update={"cars": ""})
    assert "car" not in evaluate(CenterlineFollower(speed_action=1.0), alone, [track], 2, seed=0, lap_time_ratios=False)


def test_delays_and_latencies_of_a_set_have_room(ellipse, tmp_path):
    path = tmp_path / "late.csv"
    path.write_text("steer_delay,latency\n0.06,0.1\n0.02,0.0\n")
    env = make_race_vector(8, tracks=[ellipse], beams=9, cars=str(path))
    env.reset(seed=0)
    env.step(np.zeros((8, 2)))
    assert (env.tasks.max_delay, env.tasks.max_latency) == (pytest.approx(0.06), pytest.approx(0.1))


def test_a_reset_may_choose_the_cars_of_a_list(three):
    env = make_race_vector(4, tracks=[ring()], beams=0, cars=three, autoreset_mode="Disabled")
    chosen = np.array([2, 0, 1, 2])
    _, info = env.reset(seed=0, options={"cars": chosen})
    np.testing.assert_array_equal(info["car"], chosen)
    np.testing.assert_allclose(to_records(info["vehicle"])["mu"][:, 0], np.array([1.0, 0.5, 0.75, 1.0]), rtol=1e-6)
    mask = np.array([False, True, False, False])
    _, info = env.reset(options={"reset_mask": mask, "cars": np.array([0, 1, 0, 0])})
    np.testing.assert_array_equal(info["car"], [2, 1, 1, 2])
    with pytest.raises(OutlapError, match="not all numbers of the 3 cars"):
        env.reset(options={"cars": np.full(4, 3)})
    with pytest.raises(OutlapError, match="not all numbers of the 0 cars"):
        make_race_vector(1, tracks=[ring()], beams=0).reset(options={"cars": np.zeros(1, int)})
