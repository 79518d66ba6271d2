"""Models are read from files without running code of theirs."""

from __future__ import annotations

import base64
import contextlib
import json
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from outlap.errors import OutlapError
from outlap.training import model_file
from outlap.training.model_file import load_model
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig
from outlap.training.run import Run, load_run
from outlap.training.session import train

ENV: dict[str, Any] = {
    "tracks": ("ring5",), "beams": 8, "augment_tracks": False, "control_interval": 5,
    "speed_range": (0.0, 4.0), "termination": {"time_limit": 0.5},
}  # fmt: skip
PPO: dict[str, Any] = {
    "env": {**ENV, "observation": ("scan", "vel")}, "total_steps": 128, "num_envs": 4, "n_steps": 16, "batch_size": 32,
    "n_epochs": 1, "net_arch": (8,), "clip_range": 0.3, "seed": 4,
}  # fmt: skip
CONFIGS = {
    "ppo": PPOConfig.model_validate(PPO),
    "recurrent-ppo": RecurrentPPOConfig.model_validate({**PPO, "lstm_hidden": 4}),
    "mql": MQLConfig.model_validate({"env": ENV, "total_steps": 128, "num_envs": 4, "learning_starts": 64,
                                     "buffer_size": 400, "batch_size": 8, "seed": 4}),
}  # fmt: skip


class Evil:
    """Touches a file when it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("ran"),))


@pytest.fixture
def run() -> Run:
    return train(CONFIGS["ppo"], Path("run"))


def rewritten(path: Path, **attributes: Any) -> None:
    """Put other attributes into a model's file, as pickles."""
    with zipfile.ZipFile(path) as file:
        entries = {name: file.read(name) for name in file.namelist()}
    data = json.loads(entries["data"])
    for name, value in attributes.items():
        data[name] = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(value)).decode()}
    entries["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as file:
        for name, content in entries.items():
            file.writestr(name, content)


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_a_model_is_what_stable_baselines3_itself_reads(algorithm: str) -> None:
    config = CONFIGS[algorithm]
    finished = train(config, Path("run"))
    ours: Any = load_model(config, finished.policy_path)
    theirs: Any = config.model_class().load(finished.policy_path, device="cpu")
    assert ours.num_timesteps == theirs.num_timesteps == 128
    assert len(ours.ep_info_buffer)
    assert repr(ours.ep_info_buffer) == repr(theirs.ep_info_buffer)  # NaN, where no lap was done, is NaN again
    assert ours.observation_space == theirs.observation_space
    for name, value in theirs.policy.state_dict().items():
        assert torch.equal(value, ours.policy.state_dict()[name])
    for rate in (0.0, 0.25, 1.0):
        assert ours.lr_schedule(rate) == theirs.lr_schedule(rate)
    if algorithm != "mql":
        assert ours.clip_range(1.0) == theirs.clip_range(1.0) == 0.3
    told = (theirs.__dict__.keys() - ours.__dict__.keys()) | (ours.__dict__.keys() - theirs.__dict__.keys())
    assert told <= {"rollout_buffer_class", "_last_obs", "_last_episode_starts"}


@pytest.mark.parametrize(
    "name", ["policy_class", "policy_kwargs", "learning_rate", "lr_schedule", "clip_range", "rollout_buffer_class",
             "_last_obs", "something_new"]
)  # fmt: skip
def test_code_in_a_file_is_passed_over(run: Run, name: str) -> None:
    rewritten(run.policy_path, **{name: Evil()})
    assert load_run("run").driver().beams == 8
    assert not Path("ran").exists()
    with contextlib.suppress(Exception):  # it runs the code, and then cannot do with what came of it
        run.config.model_class().load(run.policy_path)
    assert Path("ran").exists()


@pytest.mark.parametrize("name", model_file.PICKLED)
def test_code_in_place_of_data_is_refused(run: Run, name: str) -> None:
    rewritten(run.policy_path, **{name: [Evil()]})
    with pytest.raises(OutlapError, match=r"policy\.zip: cannot be loaded .*: pathlib\.Path\.touch is code"):
        load_run("run").driver()
    assert not Path("ran").exists()


def test_code_in_place_of_weights_is_refused(run: Run) -> None:
    shutil.copy(run.policy_path, "whole.zip")
    torch.save(Evil(), "evil.pth")
    with zipfile.ZipFile("whole.zip") as file, zipfile.ZipFile(run.policy_path, "w") as other:
        for name in file.namelist():
            other.writestr(name, Path("evil.pth").read_bytes() if name == "policy.pth" else file.read(name))
    with pytest.raises(OutlapError, match=r"policy\.zip: cannot be loaded as a PPO model"):
        load_run("run").driver()
    assert not Path("ran").exists()


def test_a_file_that_unpacks_to_more_than_a_model_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_file, "LARGEST", 1000)
    with pytest.raises(OutlapError, match=r"it holds [\d,]+ bytes, more than 1,000"):
        load_run("run").driver()


def test_a_missing_or_broken_file_and_one_of_other_networks_are_named(run: Run) -> None:
    with pytest.raises(OutlapError, match=r"gone\.zip: no such file"):
        load_model(run.config, "gone.zip")
    Path("broken.zip").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(OutlapError, match=r"broken\.zip: cannot be loaded as a PPO model") as error:
        load_model(run.config, "broken.zip")
    assert "\n" not in str(error.value)
    wider = PPOConfig.model_validate({**PPO, "net_arch": (16,)})
    with pytest.raises(OutlapError, match=r"cannot be loaded as a PPO model: .*size mismatch"):
        load_model(wider, run.policy_path)


def test_a_truncated_policy_gives_way_to_a_checkpoint_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    config = CONFIGS["ppo"].model_copy(update={"checkpoint_every": 64})
    finished = train(config, Path("run"))
    assert finished.policy_path.name == "policy.zip"
    assert not caplog.records
    finished.policy_path.write_bytes(finished.policy_path.read_bytes()[:500])
    assert finished.policy_path == finished.checkpoints()[0]
    assert "policy.zip: is broken; the checkpoint before it is taken" in caplog.text


def test_a_training_whose_checkpoints_do_not_fit_does_not_begin_anew() -> None:
    config = PPOConfig.model_validate({**PPO, "checkpoint_every": 64})

    def stop(progress: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, Path("run"), on_progress=stop)
    begun = load_run("run")
    kept = begun.checkpoints()
    other = Run(begun.folder, PPOConfig.model_validate({**PPO, "env": {**PPO["env"], "beams": 9}}))
    with pytest.raises(OutlapError, match="nor can those before; remove run/checkpoints to start over"):
        train(other.config, other.folder, resume=other)
    assert begun.checkpoints() == kept
    assert np.isfinite(train(config, begun.folder, resume=begun).record()["seconds"])
