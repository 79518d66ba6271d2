"""Drivers by name: every kind of name, which half of a population it may take, what runs code, and wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from outlap.drivers.classical import FollowTheGap, PurePursuit
from outlap.drivers.driver import PAPER_TERMS, FunctionDriver
from outlap.drivers.find import UNTRAINED, driver_name, find_drivers
from outlap.drivers.ghost import Ghost
from outlap.drivers.mlp import MLPDriver
from outlap.drivers.policy import PolicyDriver
from outlap.drivers.population import load_population
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.training.ppo import PPOConfig
from outlap.training.run import create_run
from small_populations import driver, population
from synthetic_tracks import ring
from untrained_policies import untrained_ppo

FIELD_OF_VIEW = 4.7  # [rad]
TASK = RaceConfig(beams=6, speed_range=(1.0, 5.0), observation=("scan", "vel"), scale_observations=True)
MODULE = """
import numpy as np
from outlap.drivers.classical import PurePursuit

def straight(observation):
    return np.zeros((len(observation["scan"]), 2))

slow = PurePursuit(speed_share=0.5, name="slow")
"""


def straight(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.zeros((len(observation["vel"]), 2))


def names(*asked: Any, **how: Any) -> list[str]:
    return [each.name for each in find_drivers(asked, FIELD_OF_VIEW, **how)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A population: ring-2.0 and ring-4.0 to train against, ring-3.0 held out."""
    return population(tmp_path / "some where", "train", "held_out", "train")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose policy is untrained."""
    run = create_run(tmp_path_factory.mktemp("runs") / "mine", PPOConfig(env=TASK, net_arch=(16, 16)))
    untrained_ppo(TASK, ring()).save(run.folder / "policy.zip")
    return run.folder


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module that can be imported, with a function and a driver."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "my_drivers.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    return "my_drivers"


@pytest.mark.parametrize("name", sorted(UNTRAINED))
def test_a_driver_without_training_is_found_by_its_name(name: str) -> None:
    (found,) = find_drivers([name], FIELD_OF_VIEW)
    assert type(found) is UNTRAINED[name]


def test_follow_the_gap_is_told_the_field_of_view() -> None:
    (found,) = find_drivers(["follow-the-gap"], 3.0)
    assert isinstance(found, FollowTheGap)
    assert found.field_of_view == 3.0


def test_a_populations_folder_is_the_drivers_of_the_half_that_is_asked_for(folder: Path) -> None:
    assert names(folder) == names(str(folder)) == ["ring-2.0", "ring-4.0"]
    assert names(folder, split="held_out") == ["ring-3.0"]
    assert names(folder, split=None) == ["ring-2.0", "ring-3.0", "ring-4.0"]


@pytest.mark.parametrize("name", ["ring-4.0", "ring-4.0.safetensors"])
def test_a_member_is_found_by_its_path(folder: Path, name: str) -> None:
    (found,) = find_drivers([folder / name], FIELD_OF_VIEW)
    assert isinstance(found, MLPDriver)
    (expected,) = load_population(folder, name="ring-4.0")
    assert (found.name, found.speeds) == ("ring-4.0", (0.0, 4.0))
    np.testing.assert_array_equal(found.weights[0], expected.weights[0])


def test_a_held_out_member_is_for_whoever_asks_for_it_and_not_for_training(folder: Path) -> None:
    with pytest.raises(OutlapError, match=r"ring-3\.0: is held out, and a train driver is asked for"):
        names(folder / "ring-3.0")
    with pytest.raises(OutlapError, match=r"ring-2\.0: is train, and a held_out driver is asked for"):
        names(folder / "ring-2.0", split="held_out")
    assert names(folder / "ring-3.0", split="held_out") == names(folder / "ring-3.0", split=None) == ["ring-3.0"]


def test_the_population_that_comes_with_outlap_has_a_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("outlap.drivers.find.SHIPPED", folder)
    assert names("population") == ["ring-2.0", "ring-4.0"]
    assert names("population/ring-4.0") == ["ring-4.0"]
    with pytest.raises(OutlapError, match=r"has no opponent 'ring-9.0'; there are ring-2\.0, ring-3\.0, ring-4\.0"):
        names("population/ring-9.0")


def test_a_recorded_lap_is_a_ghost(tmp_path: Path) -> None:
    points = np.arange(50.0).reshape(10, 5)
    path = Ghost(points).save(tmp_path / "lap.csv")
    (found,) = find_drivers([path], FIELD_OF_VIEW)
    assert isinstance(found, Ghost)
    assert found.name == "lap"
    np.testing.assert_array_equal(found.lap, points)


def test_drivers_and_functions_stand_for_themselves() -> None:
    mine = PurePursuit(speed_share=0.5, name="slow")
    found, wrapped = find_drivers([mine, straight], FIELD_OF_VIEW)
    assert found is mine
    assert isinstance(wrapped, FunctionDriver)
    assert (wrapped.name, wrapped.observation_terms, wrapped.scale_observations) == ("straight", PAPER_TERMS, False)
    assert wrapped.act({"vel": np.zeros((3, 3))}).shape == (3, 2)


def test_a_function_says_what_it_observes() -> None:
    def blind(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.zeros((len(observation["frenet"]), 2))

    blind.observation_terms = ["frenet", "vel"]  # type: ignore[attr-defined]
    (found,) = find_drivers([blind], FIELD_OF_VIEW)
    assert found.observation_terms == ("frenet", "vel")


def test_a_module_is_imported_only_where_code_may_run(module: str) -> None:
    for name in (f"{module}:straight", f"{module}:slow"):
        with pytest.raises(OutlapError, match=rf"driver {name}: is a module, which runs code when .* opponent_code"):
            names(name)
    import sys

    assert module not in sys.modules
    function, mine = find_drivers([f"{module}:straight", f"{module}:slow"], FIELD_OF_VIEW, run_code=True)
    assert isinstance(function, FunctionDriver)
    assert (function.name, mine.name) == ("straight", "slow")
    assert function.act({"scan": np.zeros((4, 6))}).shape == (4, 2)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("my_drivers:gone", r"driver my_drivers:gone: cannot be imported: .*'gone'"),
        ("no_such_module:drive", r"driver no_such_module:drive: cannot be imported: .*'no_such_module'"),
        ("my_drivers:__name__", "driver my_drivers:__name__: is 'my_drivers'; must be a Driver, a function"),
    ],
)
def test_what_a_module_does_not_have_is_named(module: str, name: str, message: str) -> None:
    with pytest.raises(OutlapError, match=message):
        names(name, run_code=True)


def test_a_run_is_its_policy(run_folder: Path) -> None:
    (found,) = find_drivers([run_folder], FIELD_OF_VIEW)
    assert isinstance(found, PolicyDriver)
    assert (found.name, found.speeds, found.beams) == ("mine", (1.0, 5.0), 6)
    assert set(found.observation_terms) == {"scan", "vel"}


def test_many_names_are_many_drivers_in_their_order(folder: Path) -> None:
    assert names("pure-pursuit", folder, driver(name="mine"), straight) == [
        "pure-pursuit", "ring-2.0", "ring-4.0", "mine", "straight",
    ]  # fmt: skip
    assert names() == []


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("stig", "driver is 'stig'; must be .*follow-the-gap, population, a population's folder"),
        ("no/such/folder", "driver is 'no/such/folder'; must be"),
        ("not a module:drive", "driver is 'not a module:drive'; must be"),
        ("module:", "driver is 'module:'; must be"),
        ("gone.csv", r"gone\.csv: cannot be read as a recorded lap"),
        (3, "driver is 3; must be a Driver, a function, or the name of one"),
        (PurePursuit, "driver is <class '.*PurePursuit'>; must be a Driver, a function, or the name of one"),
    ],
)
def test_a_wrong_name_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: Any, message: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutlapError, match=message):
        names(asked, run_code=True)


def test_a_member_that_is_not_there_is_named_with_those_that_are(folder: Path) -> None:
    with pytest.raises(OutlapError, match=r"has no opponent 'ring-5\.0'; there are ring-2\.0, ring-3\.0, ring-4\.0"):
        names(folder / "ring-5.0")
    (folder / "ring-2.0.safetensors").unlink()
    with pytest.raises(OutlapError, match=r"ring-2\.0\.safetensors: its SHA-256 is missing"):
        names(folder)


def test_a_configuration_calls_a_driver_by_its_name_or_by_what_was_given(folder: Path) -> None:
    given = ["pure-pursuit", folder, driver(name="mine"), straight]
    assert [driver_name(each) for each in given] == ["pure-pursuit", str(folder), "mine", "straight"]
