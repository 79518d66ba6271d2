"""A training: that it learns, repeats, survives being stopped, and leaves what its folder promises."""

from __future__ import annotations

import gc
import json
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from outlap.config import load_config
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.sb3_vec_env import SB3VecEnv
from outlap.errors import OutlapError
from outlap.simulator.simulator import Simulator
from outlap.track.catalog import load_tracks
from outlap.training.model_file import load_model
from outlap.training.ppo import PPOConfig
from outlap.training.run import load_run
from outlap.training.session import Progress, train
from stopped_training import stopped_after

ENV = RaceConfig(
    tracks=("ring5",),
    beams=16,
    control_interval=5,
    speed_range=(0.0, 3.0),
    observation=("scan", "vel", "frenet"),
    scale_observations=True,
    termination={"time_limit": 8.0},  # type: ignore[arg-type]
)
SMALL = PPOConfig(
    env=ENV, total_steps=512, num_envs=8, n_steps=16, batch_size=64, n_epochs=2, net_arch=(16,), checkpoint_every=128
)


def weights(path: Path) -> np.ndarray:
    model = PPO.load(path, device="cpu")
    return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])


def test_a_run_folder_holds_what_repeats_it() -> None:
    reports: list[Progress] = []
    run = train(SMALL, Path("run"), on_progress=reports.append)
    assert load_config(PPOConfig, run.folder / "config.yaml") == SMALL
    record = json.loads((run.folder / "run.json").read_text())
    assert (record["finished"], record["steps"], record["seed"]) == (True, 512, 0)
    assert record["versions"]["torch"] == torch.__version__
    assert record["tracks"] == {track.name: track.fingerprint for track in load_tracks(ENV.tracks, ENV.augment_tracks)}
    assert run.policy_path == run.folder / "policy.zip"
    assert list((run.folder / "tensorboard").glob("events.*"))
    assert [report.steps for report in reports] == [128, 256, 384, 512]
    assert len(run.checkpoints()) == 3  # of four, the newest three
    assert not list(run.folder.rglob("*.partial*"))


def test_the_same_seed_gives_the_same_policy_and_another_one_does_not() -> None:
    first, second = (train(SMALL, Path(name)) for name in ("a", "b"))
    np.testing.assert_array_equal(weights(first.policy_path), weights(second.policy_path))
    third = train(SMALL.model_copy(update={"seed": 1}), Path("c"))
    assert not np.array_equal(weights(first.policy_path), weights(third.policy_path))


def test_a_stopped_run_goes_on_where_it_was() -> None:
    stopped_after(256, SMALL, Path("run"))
    run = load_run("run")
    assert run.policy_path.name == "step_000000256.zip"
    run.write_record(seconds=1000.0)
    reports: list[Progress] = []
    train(run.config, run.folder, resume=run, on_progress=reports.append)
    assert [report.steps for report in reports] == [384, 512]
    record = run.record()  # of both sessions together
    assert record["seconds"] > 1000.0
    assert record["steps_per_second"] == round(512 / record["seconds"]) == 1
    model = PPO.load(run.folder / "policy.zip", device="cpu")
    assert model.num_timesteps == 512
    # Over which the learning rate falls: the whole training, not what was left of it.
    assert model._total_timesteps == 512


def test_a_broken_checkpoint_gives_way_to_the_one_before(caplog: pytest.LogCaptureFixture) -> None:
    stopped_after(384, SMALL, Path("run"))
    run = load_run("run")
    newest = run.checkpoints()[0]
    newest.write_bytes(newest.read_bytes()[:1000])
    reports: list[Progress] = []
    train(run.config, run.folder, resume=run, on_progress=reports.append)
    assert reports[0].steps == 384
    assert newest.name in json.dumps(json.loads((run.folder / "run.json").read_text()))
    assert f"{newest}: cannot be read, and is left out" in caplog.text


def test_a_network_that_diverges_ends_the_training_and_spares_what_was_saved() -> None:
    stopped_after(256, SMALL, Path("run"))
    run = load_run("run")
    kept = run.checkpoints()
    said = f"diverged: .* is NaN or beyond 1e\\+08 after .* checkpoint is {kept[0]}; train again"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stable_baselines3.ppo.PPO.load", _loaded_with(1e30))
        with pytest.raises(OutlapError, match=said):
            train(run.config, run.folder, resume=run)
    assert run.checkpoints() == kept
    assert not (run.folder / "policy.zip").exists()
    assert train(run.config, run.folder, resume=load_run("run")).finished


def _loaded_with(rate: float):
    """PPO.load, with another learning rate than the checkpoint's."""
    load = PPO.load

    def loaded(*args, **settings):
        model = load(*args, **settings)
        model.learning_rate = rate
        model._setup_lr_schedule()
        return model

    return loaded


def test_a_full_disk_is_an_error_of_storage_and_what_was_saved_stays() -> None:
    stopped_after(256, SMALL, Path("run"))
    run = load_run("run")
    kept = {path: path.read_bytes() for path in run.checkpoints()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, hard))  # no file grows beyond: as on a full disk
    try:
        with pytest.raises(OSError, match="File too large"):
            train(run.config, run.folder, resume=run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {path: path.read_bytes() for path in run.checkpoints()} == kept
    assert not list(run.folder.rglob("*.partial*"))
    assert train(run.config, run.folder, resume=load_run("run")).finished


@pytest.mark.parametrize("stopped", [False, True])
def test_a_training_gives_its_memory_back_at_once(stopped: bool) -> None:
    train(SMALL, Path("first"))  # what libraries keep of their import is kept once
    gc.collect()
    gc.disable()
    try:
        if stopped:
            stopped_after(256, SMALL, Path("run"))
        else:
            train(SMALL, Path("run"))
        assert not [thing for thing in gc.get_objects() if type(thing) in (SB3VecEnv, PPO, Simulator)]
    finally:
        gc.enable()


def test_a_finished_run_is_not_trained_further() -> None:
    run = train(SMALL, Path("run"))
    before = weights(run.policy_path)
    train(run.config, run.folder, resume=load_run("run"))
    np.testing.assert_array_equal(weights(run.policy_path), before)


def test_curricula_go_on_from_where_the_run_was(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []
    monkeypatch.setattr(RaceVectorEnv, "training_progress", property(lambda env: 1.0, lambda env, p: seen.append(p)))
    stopped_after(256, SMALL, Path("run"))
    assert seen == [0.0, 0.25]
    run = load_run("run")
    train(run.config, run.folder, resume=run)
    assert seen[2:] == [0.5, 0.75]


@pytest.mark.parametrize("steps", [512, 1024])
def test_a_training_of_another_length_has_the_same_curricula(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a training is half, and its last rollout of 128 is near the end, however long it is."""
    seen: list[float] = []
    monkeypatch.setattr(RaceVectorEnv, "training_progress", property(lambda env: 1.0, lambda env, p: seen.append(p)))
    train(SMALL.model_copy(update={"total_steps": steps, "checkpoint_every": 10**6}), Path("run"))
    np.testing.assert_allclose(seen, np.arange(0, steps, 128) / steps)


def test_nothing_is_overwritten_and_mistakes_leave_no_folder() -> None:
    train(SMALL, Path("run"))
    with pytest.raises(OutlapError, match="holds a run already"):
        train(SMALL, Path("run"))
    with pytest.raises(OutlapError, match="no track is called 'nowhere'"):
        train(SMALL.model_copy(update={"env": ENV.model_copy(update={"tracks": ("nowhere",)})}), Path("other"))
    assert not Path("other").exists()
    with pytest.raises(OutlapError, match="is not a run folder"):
        load_run("other")


def test_it_learns_to_drive_round_a_ring() -> None:
    config = SMALL.model_copy(
        update={"total_steps": 24_000, "num_envs": 16, "n_steps": 32, "batch_size": 128, "n_epochs": 5,
                "learning_rate": 1e-3, "checkpoint_every": 10**9}
    )  # fmt: skip
    reports: list[Progress] = []
    train(config, Path("run"), on_progress=reports.append)
    begin, end = reports[2].progress_m, reports[-1].progress_m
    assert begin is not None
    assert end is not None
    assert end > 2.0 * begin  # metres before the episode ends


def test_a_bounded_mean_is_kept_through_a_run_folder() -> None:
    """The policy of the run folder is the bounded one, and its mean stays inside where its layers would leave it."""
    run = train(SMALL.model_copy(update={"bounded_mean": True}), Path("run"))
    policy = load_model(run.config, run.policy_path).policy
    seen = {name: torch.ones(1, *box.shape) for name, box in policy.observation_space.spaces.items()}  # type: ignore[attr-defined]
    with torch.no_grad():
        policy.action_net.weight *= 1e3  # type: ignore[union-attr, operator]
        mean = policy.get_distribution(seen).distribution.mean  # type: ignore[operator, union-attr]
    assert (mean.abs() <= 1.0).all()
    assert (mean.abs() > 0.9).any()


@pytest.mark.parametrize("cars", ["hard", "outside:10"])
def test_test_cars_are_not_trained_on(cars) -> None:
    with pytest.raises(ValueError, match="must not be a split of test cars"):
        PPOConfig(env=ENV.model_copy(update={"cars": cars}))
