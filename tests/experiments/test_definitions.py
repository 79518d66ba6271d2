"""Methods, task sets and budgets as files."""

from __future__ import annotations

from pathlib import Path

import pytest

from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.experiments.definitions import (
    FOLDERS,
    Budget,
    Circuits,
    Method,
    TaskSetConfig,
    changed,
    find,
    merge,
    names_of,
)
from outlap.track.generate import BUILTIN_HELD_OUT, BUILTIN_TRAIN


@pytest.mark.parametrize("kind", [Method, TaskSetConfig, Budget])
def test_everything_that_comes_with_outlap_can_be_loaded_by_its_name(kind):
    names = names_of(kind)
    assert names == sorted(path.stem for path in FOLDERS[kind].glob("*.yaml"))
    for name in names:
        found, definition = find(kind, name)
        assert found == name
        assert isinstance(definition, kind)


def test_what_a_sceptic_asks_for_is_there():
    assert {"vanilla-dr", "mql", "mql-abc", "td3", "mql-no-adaptation", "mql-no-clip", "recurrent-ppo"} < set(
        names_of(Method)
    )
    assert any(find(Method, name)[1].driver for name in names_of(Method))


def test_a_file_of_ones_own_is_named_by_its_path(tmp_path: Path):
    path = tmp_path / "slow-ppo.yaml"
    path.write_text("title: Slow\ntraining: {algorithm: ppo, learning_rate: 1.0e-5}\n")
    name, method = find(Method, str(path))
    assert (name, method.title, method.training["learning_rate"]) == ("slow-ppo", "Slow", 1e-5)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("title: x", "must have either a driver or a training"),
        ("title: x\ndriver: follow-the-gap\ntraining: {algorithm: ppo}", "must have either a driver or a training"),
        ("title: x\ntraining: {gamma: 0.9}", "training must name an algorithm"),
        ("title: x\ntraining: {algorithm: ppo}\nadaptation: {clip: abc}", "adaptation is of algorithm mql alone"),
        (
            "title: x\ntraining: {algorithm: mql}\nadaptation: {iterations: 3}",
            "must have a clip, one of none, fixed, abc",
        ),
        ("title: x\ntraining: {algorithm: ppo, env: {beams: 54}}", "training may not change env.beams"),
        ("title: x\ntrainig: {algorithm: mql}", "did you mean training?"),
    ],
)
def test_a_wrong_method_is_one_line(content: str, said: str, tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    with pytest.raises(OutlapError) as error:
        find(Method, str(path))
    assert str(path) in str(error.value)
    assert said in str(error.value)


def test_an_unknown_name_lists_those_that_there_are():
    with pytest.raises(OutlapError, match=r"budget is 'huge'; must be a .yaml file, or one of cpu, paper, smoke"):
        find(Budget, "huge")


def test_merging_goes_into_mappings_and_leaves_the_originals():
    base = {"a": {"b": 1, "c": 2}, "d": 3}
    assert merge(base, {"a": {"b": 5}}, {"d": {"e": 1}}) == {"a": {"b": 5, "c": 2}, "d": {"e": 1}}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}


def test_an_environment_is_changed_and_a_wrong_field_named():
    env = changed(RaceConfig(), {"vehicle": {"mu": {"min": 0.5, "max": 0.6}}}, {"vehicle": {"m": 4.0}})
    assert (env.vehicle.mu, env.vehicle.m) == ((0.5, 0.6), 4.0)
    with pytest.raises(OutlapError, match=r"env: vehicle.mus is not a known field; did you mean mu"):
        changed(RaceConfig(), {"vehicle": {"mus": 1.0}})


def test_circuits_are_the_first_that_are_all_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path))
    _, tracks = find(TaskSetConfig, "tracks")
    builtin = tracks.circuits[-1]
    assert {*builtin.train} <= {*BUILTIN_TRAIN}
    assert {*builtin.held_out} <= {*BUILTIN_HELD_OUT}
    assert tracks.find_circuits(built_in=False) == builtin
    assert "built-in" in builtin.title
    paper = tracks.circuits[0]
    for name in (*paper.train, *paper.held_out):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}_map.yaml").write_text("")  # found by name, and not read
    assert tracks.find_circuits(built_in=False) == paper
    assert tracks.find_circuits(built_in=True) == builtin


def test_no_circuit_is_both_trained_on_and_held_out():
    for name in names_of(TaskSetConfig):
        for circuits in find(TaskSetConfig, name)[1].circuits:
            assert isinstance(circuits, Circuits)
            assert not {*circuits.train} & {*circuits.held_out}
