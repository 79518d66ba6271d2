"""A training session, the same for every algorithm: from the run folder to the finished policy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # type: ignore[attr-defined]

from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.sb3_vec_env import SB3VecEnv
from outlap.envs.tasks import TaskSet, TaskSplit
from outlap.files import remove_partials
from outlap.provenance import provenance
from outlap.track.catalog import load_tracks
from outlap.training.callback import Progress, Stopwatch, TrainingCallback
from outlap.training.checkpoints import check_finite, newest_model, reseed, save_checkpoint, save_progress
from outlap.training.config import TrainingConfig, check_device
from outlap.training.run import Run, create_run


def train(
    config: TrainingConfig,
    folder: Path,
    *,
    resume: Run | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Run:
    """Train a policy; write checkpoints and logs to a run folder, and return the finished run.

    Args:
        config: of the training.
        folder: of the run; must not hold a run, unless it is `resume`'s.
        resume: a run to continue from its newest checkpoint; a finished one is returned as it is.
        on_progress: called at the end of a rollout, see `TrainingConfig.report_every`.

    Raises OutlapError for a device that is not there, a track that cannot be loaded, a folder that holds a run, a
    network that diverges. A KeyboardInterrupt passes through once a checkpoint is written.
    """
    if resume is not None and resume.finished:
        return resume
    if config.threads:
        torch.set_num_threads(config.threads)
    # Every error in the configuration is found here, before the folder is made.
    check_device(config.device)
    environment = SB3VecEnv(RaceVectorEnv(config.num_envs, config.env))
    if config.held_out_tracks:
        TaskSplit(environment.env.tasks, TaskSet(load_tracks(config.held_out_tracks)))
    model = None if resume else config.make_model(environment)
    run = resume or create_run(folder, config)
    if model is None:
        run.write_record(resumed=[*run.record().get("resumed", []), provenance()])
        remove_partials(run.folder)
        model = newest_model(run, environment, config) or config.make_model(environment)
    run.write_record(tracks={track.name: track.fingerprint for track in environment.env.tasks.tracks})
    clock = Stopwatch(float(run.record().get("seconds", 0.0)) if model.num_timesteps else 0.0)
    _learn(model, config, run, clock, on_progress)
    check_finite(model, run)
    save_checkpoint(run, model, "policy.zip", "replay.npz")
    run.note_pace(
        model.num_timesteps,
        clock.seconds,
        finished=True,
        compile_seconds=environment.env.race.simulator.compile_seconds,
    )
    return run


def _learn(
    model: Any, config: TrainingConfig, run: Run, clock: Stopwatch, on_progress: Callable[[Progress], None] | None
) -> None:
    """Train a model for the steps that are left; write a checkpoint if a KeyboardInterrupt passes through."""
    begun_at = model.num_timesteps
    reseed(model, config)
    model.set_logger(_make_logger(run.folder / "tensorboard", begun_at))
    callback = TrainingCallback(run, config, clock, on_progress)
    try:
        if begun_at < config.total_steps:
            model.learn(
                config.total_steps - begun_at,
                callback=callback,
                log_interval=config.log_interval,
                reset_num_timesteps=begun_at == 0,
            )
    except KeyboardInterrupt:
        save_progress(run, model, clock.seconds)
        raise
    except Exception:
        check_finite(model, run)  # a network that has diverged breaks other things first
        raise
    finally:
        callback.locals = {}  # model and callback refer to each other there, and keep all worlds in memory


def _make_logger(folder: Path, begun_at: int) -> Logger:
    """Log to TensorBoard; its readers drop what an earlier session logged beyond the checkpoint that is resumed."""
    output = TensorBoardOutputFormat(str(folder))
    assert output.writer.file_writer is not None
    # In the log's own file: of two that were begun in one second, readers may take either first.
    output.writer.file_writer.add_event(Event(step=begun_at + 1, session_log=SessionLog(status=SessionLog.START)))
    return Logger(str(folder), [output])
