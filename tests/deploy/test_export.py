"""An exported file does what its policy does, step by step, for every algorithm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from outlap.cli.main import main
from outlap.deploy.car_driver import METADATA, CarDriver
from outlap.deploy.export import compare, export_policy
from outlap.envs import RaceVectorEnv, SB3VecEnv
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.track.map_io import write_track
from outlap.training.config import TrainingConfig
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig
from outlap.training.run import Run, create_run
from synthetic_tracks import ring

TERMS = ("scan", "vel", "heading", "previous_action")
ENV: dict[str, Any] = {"beams": 40, "control_interval": 4, "observation": TERMS, "speed_range": (0.0, 4.0)}
SMALL: dict[str, Any] = {"num_envs": 2, "total_steps": 100}
PPO: dict[str, Any] = {**SMALL, "n_steps": 8, "batch_size": 8, "net_arch": (16, 16)}
META = {**ENV, "observation": (*TERMS, "previous_reward"), "scale_observations": True}


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_track(ring(radius=6.0, half_width=1.5), tmp_path_factory.mktemp("maps") / "ring6"))


def run_of(config: type[TrainingConfig], folder: Path, track: str, env: dict[str, Any], **settings: Any) -> Run:
    """A run whose policy has learnt nothing, and acts all over its range."""
    run = create_run(folder, config(env=RaceConfig(tracks=(track,), **env), **settings))
    model = run.config.make_model(SB3VecEnv(RaceVectorEnv(2, run.config.env)))
    policy: Any = model.policy
    with torch.no_grad():  # both begin with actions near 0
        last = policy.actor.head[-1] if hasattr(policy, "actor") else policy.action_net
        last.weight *= 10.0 if hasattr(policy, "actor") else 50.0
    model.save(run.folder / "policy.zip")
    return run


@pytest.mark.parametrize(
    ("config", "env", "settings"),
    [
        (PPOConfig, ENV, PPO),
        (RecurrentPPOConfig, {**ENV, "scale_observations": True}, {**PPO, "lstm_hidden": 8}),
        (MQLConfig, META, {**SMALL, "preset": "fast"}),
        (MQLConfig, META, {**SMALL, "preset": "paper", "history": 4}),
        (MQLConfig, {**ENV, "reward": "paper"}, {**SMALL, "preset": "fast", "uses_reward": False}),
        (MQLConfig, ENV, {**SMALL, "preset": "fast", "uses_context": False, "uses_reward": False}),
    ],
    ids=["ppo", "recurrent-ppo", "mql-fast", "mql-paper", "mql-without-reward", "td3"],
)
def test_the_file_does_what_the_policy_does(tmp_path: Path, track: str, config, env, settings):
    run = run_of(config, tmp_path / "run", track, env, **settings)
    export_policy(run, tmp_path / "policy.onnx")
    driver = CarDriver(tmp_path / "policy.onnx")
    of_action, of_command = compare(run, driver, steps=400)
    assert of_action < 1e-5
    assert of_command < 1e-4  # [rad] or [m/s]: of float32
    assert (driver.beams, driver.interval, driver.speeds) == (40, pytest.approx(0.04), (0.0, 4.0))


def test_a_memory_makes_a_difference_and_begin_forgets_it(tmp_path: Path, track: str):
    run = run_of(MQLConfig, tmp_path / "run", track, META, **SMALL)
    export_policy(run, tmp_path / "policy.onnx")
    driver = CarDriver(tmp_path / "policy.onnx")
    rng = np.random.default_rng(0)
    sizes = {"scan": 40, "vel": 3, "heading": 2, "previous_reward": 1}
    first, second = ({n: rng.uniform(0, 2, k).astype(np.float32) for n, k in sizes.items()} for _ in range(2))
    alone = driver.act(second)
    driver.begin()
    driver.act(first)
    assert np.abs(driver.act(second) - alone).max() > 1e-4
    driver.begin()
    np.testing.assert_array_equal(driver.act(second), alone)


def test_what_a_car_cannot_tell_is_refused(tmp_path: Path, track: str):
    for name, config, env, settings, said in (
        (
            "map",
            PPOConfig,
            {**ENV, "observation": ("scan", "frenet")},
            PPO,
            "observes 'frenet', which a car cannot tell",
        ),
        ("reward", MQLConfig, {**META, "reward": "paper"}, SMALL, "observes rewards for milestone, which a car cannot"),
        (
            "vehicle",
            PPOConfig,
            {**ENV, "observation": ("scan", "vehicle")},
            PPO,
            "observes 'vehicle', which a car cannot tell",
        ),
        (
            "command",
            PPOConfig,
            {**ENV, "command": "acceleration"},
            PPO,
            "commands the acceleration; a car takes speeds",
        ),
    ):
        run = run_of(config, tmp_path / name, track, env, **settings)
        with pytest.raises(OutlapError, match=said):
            export_policy(run, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


@pytest.mark.parametrize("output", ["action", "command"])
def test_a_file_that_gives_nan_is_refused_and_removed(
    tmp_path: Path, track: str, output: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    run = run_of(PPOConfig, tmp_path / "run", track, ENV, **PPO)
    path = run.folder / "policy.onnx"

    def export_broken(run: Run, path: Path) -> dict[str, Any]:
        facts = export_policy(run, path)
        proto = onnx.load(path)
        for node in proto.graph.node:
            node.output[:] = ["before" if name == output else name for name in node.output]
            node.input[:] = ["before" if name == output else name for name in node.input]
        nothing = onnx.helper.make_tensor("nothing", onnx.TensorProto.FLOAT, [2], [np.nan, 0.0])
        proto.graph.initializer.append(nothing)
        proto.graph.node.append(onnx.helper.make_node("Add", ["before", "nothing"], [output]))
        onnx.save(proto, path)
        return facts

    monkeypatch.setattr("outlap.deploy.export.export_policy", export_broken)
    assert main(["export", str(run.folder), "--steps", "20"]) == 2
    assert "nan in its " + output in capfd.readouterr()[1]
    assert not path.exists()


def test_files_that_are_no_exported_policy(tmp_path: Path, track: str):
    run = run_of(PPOConfig, tmp_path / "run", track, ENV, **PPO)
    export_policy(run, tmp_path / "good.onnx")
    proto = onnx.load(tmp_path / "good.onnx")
    facts = json.loads(next(prop.value for prop in proto.metadata_props if prop.key == METADATA))
    onnx.helper.set_model_props(proto, {METADATA: json.dumps({**facts, "format": 99})})
    onnx.save(proto, tmp_path / "future.onnx")
    onnx.helper.set_model_props(proto, {"other": "{}"})
    onnx.save(proto, tmp_path / "stranger.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    for name, said in (
        ("missing.onnx", "no such file; make one with outlap export"),
        ("text.onnx", "is no policy of outlap export"),
        ("stranger.onnx", "is no policy of outlap export"),
        ("future.onnx", "its format is 99"),
    ):
        with pytest.raises(OutlapError, match=said):
            CarDriver(tmp_path / name)


def test_the_command_compares_what_it_wrote(tmp_path: Path, track: str, capfd: pytest.CaptureFixture[str]):
    run = run_of(PPOConfig, tmp_path / "run", track, ENV, **PPO)
    assert main(["export", str(run.folder), "--steps", "50", "--json", "-"]) == 0
    data = json.loads(capfd.readouterr()[0])
    assert data["largest_action_difference"] < 1e-5
    assert data["bytes"] == (run.folder / "policy.onnx").stat().st_size
    for words, said in (
        (["export", str(run.folder), "--out", "policy.bin"], "must end in .onnx"),
        (["export", str(tmp_path)], "is not a run folder"),
    ):
        assert main(words) == 2
        assert said in capfd.readouterr()[1]
