"""Checkpoints: write them, resume from the newest one, and derive all randomness that follows from them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from outlap.errors import OutlapError
from outlap.files import replacing
from outlap.mql import collector
from outlap.mql.mql import MQL
from outlap.training.config import TrainingConfig
from outlap.training.model_file import load_model
from outlap.training.run import Run

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from outlap.envs.sb3_vec_env import SB3VecEnv

log = logging.getLogger(__name__)

CHECKPOINTS_KEPT = 3
LARGEST_WEIGHT = 1e8  # of a network that has not diverged


class TrainingDiverged(OutlapError):
    """A network's parameters are NaN or huge."""


def save_checkpoint(run: Run, model: Any, name: str, replay_name: str) -> None:
    """Write a model, and its replay buffer before it: no model is ever without the buffer that belongs to it.

    Both are written beside their places and renamed there. Then the oldest checkpoints and other replays are removed.
    """
    path, replay = run.folder / name, run.folder / replay_name
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        model.save_replay_buffer(replay)
    with replacing(path) as partial:
        model.save(partial)
    for old in {*run.checkpoints()[CHECKPOINTS_KEPT:], *run.replays()} - {replay}:
        old.unlink(missing_ok=True)


def save_progress(run: Run, model: BaseAlgorithm, seconds: float) -> None:
    """Write a checkpoint that is named after the model's steps, and note it in run.json."""
    name = f"checkpoints/step_{model.num_timesteps:09d}"
    save_checkpoint(run, model, f"{name}.zip", f"{name}.npz")
    run.note_pace(model.num_timesteps, seconds)


def newest_model(run: Run, environment: SB3VecEnv, config: TrainingConfig) -> BaseAlgorithm | None:
    """Load the newest readable checkpoint, with its replay buffer; None without any checkpoint.

    Raises OutlapError if there are checkpoints, and none can be read.
    """
    error = None
    for path in run.checkpoints():
        try:
            model = load_model(config, path, environment, config.device)
        except OutlapError as wrong:  # the one before may be whole
            log.warning("%s: cannot be read, and is left out; the one before is taken", path)
            run.write_record(**{f"unreadable_{path.name}": str(wrong)})
            error = error or wrong
            continue
        own = path.with_suffix(".npz")
        replay = own if own.exists() else run.replay_path
        if replay.exists():
            try:
                model.load_replay_buffer(replay)  # type: ignore[attr-defined]
            except OutlapError as error:
                log.warning("%s; the training continues with an empty one", error)
        return model
    if error is not None:
        raise OutlapError(f"{error}; nor can those before; remove {run.folder}/checkpoints to start over") from error
    return None


def check_finite(model: Any, run: Run) -> None:
    """Raise TrainingDiverged for a network that has diverged, before it drives or is saved."""
    for name, parameter in model.policy.named_parameters():
        if not (parameter.abs() < LARGEST_WEIGHT).all():  # nor is NaN
            kept = run.checkpoints()
            last = f"the last good checkpoint is {kept[0]}" if kept else "there is no checkpoint yet"
            raise TrainingDiverged(
                f"{run.folder}: the training diverged: {name} is NaN or beyond {LARGEST_WEIGHT:g} after "
                f"{model.num_timesteps:,} steps; {last}; train again with a lower --learning-rate"
            )


def reseed(model: Any, config: TrainingConfig) -> None:
    """Derive all further random numbers from the run's seed and the model's number of steps.

    It is called where a training begins and after each checkpoint. What follows a checkpoint then depends on nothing
    but the checkpoint: a resumed training is, bit for bit, the one that was never stopped.
    """
    model.set_random_seed(int(np.random.SeedSequence([config.seed, model.num_timesteps]).generate_state(1)[0]))


def begin_episodes(model: Any) -> None:
    """Begin an episode in every world, as `learn` does when it resumes a training."""
    environment = model.env
    model._last_obs = environment.reset()
    model._last_episode_starts = np.ones(model.n_envs, bool)
    if isinstance(model, MQL):
        collector.begin_episodes(model.replay_buffer, environment, model._last_obs)
