"""Perceptrons as data: what PPO says, alone and in company, through a file and back; broken files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from outlap.drivers.bounded_policy import BoundedPolicy
from outlap.drivers.mlp import MLPDriver, MLPStack
from outlap.drivers.population import load_population, read_manifest, write_manifest
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from small_populations import driver, population
from synthetic_tracks import ring
from untrained_policies import untrained_ppo

TASK = RaceConfig(beams=24, control_interval=4, observation=("scan", "vel", "heading"), scale_observations=True)


def observations(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    return {name: rng.normal(size=(n, size)).astype(np.float32) for name, size in driver().sizes.items()}


def test_it_acts_as_the_policy_that_it_was_made_of() -> None:
    model = untrained_ppo(TASK, ring(), width=32)
    ours = MLPDriver.from_ppo(model, "copy", True, (0.0, 4.0))
    seen = observations(50)
    np.testing.assert_allclose(ours.act(seen), model.predict(seen, deterministic=True)[0], atol=1e-6)


def test_a_stack_gives_each_car_its_own_drivers_action() -> None:
    drivers = [driver(seed) for seed in range(4)]
    which = np.array([3, 0, 0, 1, 3, 3, 0])  # nobody asks for 2
    seen = observations(7)
    together = MLPStack(drivers).act(which, seen)
    for i, number in enumerate(which):
        alone = drivers[number].act({name: value[i : i + 1] for name, value in seen.items()})
        np.testing.assert_allclose(together[i], alone[0], atol=1e-6)
    assert MLPStack(drivers).act(np.zeros(0, np.int64), observations(0)).shape == (0, 2)


def test_an_action_does_not_depend_on_the_cars_beside_it_by_a_single_bit() -> None:
    seen = observations(127)
    together = driver().act(seen)
    for count in (1, 2, 17, 100):
        some = driver().act({name: value[:count] for name, value in seen.items()})
        np.testing.assert_array_equal(some, together[:count])


def test_a_file_brings_back_the_same_driver(tmp_path: Path) -> None:
    driver().save(tmp_path / "v2.0")
    again = MLPDriver.load(tmp_path / "v2.0")
    assert (again.name, again.sizes, again.speeds) == ("one", driver().sizes, (0.0, 4.0))
    np.testing.assert_array_equal(again.act(observations(5)), driver().act(observations(5)))


def test_a_wrong_observation_is_named() -> None:
    seen = observations(3)
    seen["scan"] = seen["scan"][:, :20]
    with pytest.raises(OutlapError, match=r"one: observation 'scan' has shape \(3, 20\); must be \(3, 24\)"):
        driver().act(seen)


def damage(path: Path, what: str) -> None:
    facts = json.loads((path.parent / "one.json").read_text())
    tensors = load_file(path.parent / "one.safetensors")
    if what == "missing":
        (path.parent / "one.safetensors").unlink()
    elif what == "truncated":
        (path.parent / "one.safetensors").write_bytes((path.parent / "one.safetensors").read_bytes()[:100])
    elif what == "shape":
        save_file({**tensors, "weight_1": tensors["weight_1"][:, :3].copy()}, path.parent / "one.safetensors")
    elif what == "nan":
        save_file({**tensors, "bias_0": tensors["bias_0"] * np.float32("nan")}, path.parent / "one.safetensors")
    elif what == "activation":
        (path.parent / "one.json").write_text(json.dumps({**facts, "activation": "os.system"}))
    elif what == "facts":
        (path.parent / "one.json").write_text("[]")


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("missing", "cannot be read as a driver"),
        ("truncated", "cannot be read as a driver"),
        ("shape", r"layer 1 has weights \(16, 3\); must be \(16, 16\)"),
        ("nan", "layer 0 holds numbers that are not finite"),
        ("activation", "activation is 'os.system'; must be one of tanh, relu"),
        ("facts", "cannot be read as a driver"),
    ],
)
def test_a_broken_file_is_named(tmp_path: Path, what: str, message: str) -> None:
    driver().save(tmp_path / "one")
    damage(tmp_path / "one", what)
    with pytest.raises(OutlapError, match=message):
        MLPDriver.load(tmp_path / "one")


def test_a_population_has_two_halves_that_do_not_meet(tmp_path: Path) -> None:
    population(tmp_path, "train", "held_out", "train")
    assert [member.name for member in read_manifest(tmp_path)] == ["ring-2.0", "ring-3.0", "ring-4.0"]
    assert [each.name for each in load_population(tmp_path)] == ["ring-2.0", "ring-4.0"]
    assert [each.name for each in load_population(tmp_path, "held_out")] == ["ring-3.0"]


def test_a_tampered_or_empty_population_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutlapError, match=r"is no population, it has no manifest\.json"):
        load_population(tmp_path)
    write_manifest(tmp_path, [])
    with pytest.raises(OutlapError, match=r"manifest\.json: names no opponent"):
        load_population(tmp_path)
    population(tmp_path, "train")
    with pytest.raises(OutlapError, match="has no opponent in its held_out half"):
        load_population(tmp_path, "held_out")
    driver(9).save(tmp_path / "ring-2.0")
    with pytest.raises(OutlapError, match=r"ring-2\.0\.(json|safetensors): its SHA-256 is [0-9a-f]+, and manifest"):
        load_population(tmp_path)


def test_a_policy_with_a_bounded_mean_stays_one_through_a_file(tmp_path: Path) -> None:
    model = untrained_ppo(TASK, ring(), width=32, policy=BoundedPolicy)
    ours = MLPDriver.from_ppo(model, "copy", True, (0.0, 4.0))
    seen = observations(50)
    expected = model.predict(seen, deterministic=True)[0]
    assert np.abs(expected).max() < 1.0  # the tanh leaves nothing to clip
    np.testing.assert_allclose(ours.act(seen), expected, atol=1e-6)
    ours.save(tmp_path / "bounded")
    np.testing.assert_array_equal(MLPDriver.load(tmp_path / "bounded").act(seen), ours.act(seen))
    with pytest.raises(OutlapError, match="another architecture"):
        MLPStack([ours, MLPDriver.from_ppo(untrained_ppo(TASK, ring(), width=32), "free", True, (0.0, 4.0))])
