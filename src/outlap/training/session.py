"""A training session: what every algorithm has in common, from the first folder to the finished policy."""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, field_validator
from tyro.conf import arg

from outlap.config import Config
from outlap.envs.race_config import RaceConfig
from outlap.envs.tasks import TaskSet, TaskSplit
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.files import remove_partials
from outlap.track.catalog import load_tracks
from outlap.training.device import check_device
from outlap.training.model_file import load_model
from outlap.training.run import Run, create_run, save_checkpoint

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.logger import Logger

    from outlap.envs.sb3_vec_env import SB3VecEnv

log = logging.getLogger(__name__)

LARGEST_WEIGHT = 1e8  # of a network that has not diverged
RECENT_EPISODES = 500  # over which training statistics are taken; a checkpoint keeps them


class TrainingDiverged(OutlapError):
    """A network's parameters are NaN or huge."""


class TrainingConfig(Config):
    """A training. Each algorithm has its own, named by the field `algorithm`."""

    policy_name: ClassVar[str]  # of the networks, as the algorithm calls them

    algorithm: str
    env: RaceConfig = RaceConfig()
    held_out_tracks: tuple[str, ...] = ()  # what `outlap evaluate` takes by default; refused if also trained on
    total_steps: Annotated[int, arg(aliases=["--steps"])] = Field(default=2_000_000, gt=0)  # actions, all worlds
    num_envs: int = Field(default=128, ge=1)
    seed: int = Field(default=0, ge=0)
    learning_rate: float = Field(default=5e-4, gt=0)
    learning_rate_decay: bool = True  # linearly to zero at total_steps
    gamma: float = Field(default=0.99, gt=0, le=1)
    device: str = "cpu"  # of PyTorch: cpu, cuda, cuda:1, or auto for a GPU if there is one
    threads: int = Field(default=0, ge=0)  # of PyTorch; 0 = one a core
    checkpoint_every: int = Field(default=250_000, gt=0)  # actions

    @field_validator("env")
    @classmethod
    def _held_out_opponents_are_for_evaluation(cls, env: RaceConfig) -> RaceConfig:
        if env.opponent_split != "train":
            raise ValueError("opponent_split is 'held_out'; must be 'train': no training meets the held-out half")
        return env

    @abstractmethod
    def model_class(self) -> type[BaseAlgorithm]:
        """The algorithm."""

    @abstractmethod
    def constants(self) -> dict[str, Any]:
        """What the algorithm is built with, but its networks."""

    @abstractmethod
    def network(self) -> dict[str, Any]:
        """What the networks are built with."""

    def make_model(self, environment: SB3VecEnv) -> BaseAlgorithm:
        """A model that has learnt nothing yet."""
        networks = {"policy_kwargs": self.network()}
        return self.model_class()(self.policy_name, environment, **self.constants(), **networks)  # type: ignore[arg-type]

    @property
    def report_every(self) -> int:
        """Actions between two reports of progress, at the end of a rollout."""
        return 0

    @property
    def log_interval(self) -> int:
        """Of `learn`: between two lines of the log, in the algorithm's own count."""
        return 1

    def schedule(self) -> Callable[[float], float] | float:
        """The learning rate as a function of the progress remaining, 1 … 0."""
        rate = self.learning_rate
        return (lambda remaining: rate * remaining) if self.learning_rate_decay else rate


@dataclass(frozen=True)
class Progress:
    """How a training stands, for whoever shows it."""

    steps: int
    total_steps: int
    steps_per_second: float
    crash_rate: float | None  # of recent episodes
    mean_speed_mps: float | None
    progress_m: float | None


class Stopwatch:
    """Seconds of a training, those of earlier sessions included."""

    def __init__(self, before: float) -> None:
        self._start = time.monotonic() - before

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start


def train(
    config: TrainingConfig,
    folder: Path,
    *,
    resume: Run | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Run:
    """Train, writing checkpoints and logs to a run folder; returns the finished run.

    Args:
        config: what to train.
        folder: where; must not hold a run, unless it is `resume`'s.
        resume: a run to continue from its newest checkpoint; one that is finished is handed back.
        on_progress: called at the end of a rollout, see `TrainingConfig.report_every`.

    Raises OutlapError for a device that is not there, a track that cannot be loaded, a folder that holds a run, a
    network that diverges. A KeyboardInterrupt passes through once a checkpoint is written.
    """
    if resume is not None and resume.finished:
        return resume
    import torch

    from outlap.envs.sb3_vec_env import SB3VecEnv

    if config.threads:
        torch.set_num_threads(config.threads)
    # Everything that can be wrong with the configuration is found here, before the folder is made.
    check_device(config.device)
    environment = SB3VecEnv(config.num_envs, **dict(config.env))
    if config.held_out_tracks:
        TaskSplit(environment.env.tasks, TaskSet(load_tracks(config.held_out_tracks)))
    model = None if resume else config.make_model(environment)
    run = resume or create_run(folder, config)
    if resume:
        run.begin_session()
        remove_partials(run.folder)
        model = _newest_model(run, environment, config) or config.make_model(environment)
    assert model is not None
    run.write_record(tracks={track.name: track.fingerprint for track in environment.env.tasks.tracks})
    begun_at = model.num_timesteps
    environment.env.training_steps = begun_at
    _seed_stint(model, config)
    model.set_logger(_make_logger(run.folder / "tensorboard", begun_at))
    clock = Stopwatch(float(run.record().get("seconds", 0.0)) if begun_at else 0.0)
    watcher = _watcher(run, config, clock, on_progress)
    try:
        if begun_at < config.total_steps:
            model.learn(
                config.total_steps - begun_at,
                callback=watcher,
                log_interval=config.log_interval,
                reset_num_timesteps=begun_at == 0,
            )
    except KeyboardInterrupt:
        _save(run, model, clock)
        raise
    except Exception:
        _check_finite(model, run)  # a network that has diverged breaks other things first
        raise
    finally:
        watcher.locals = {}  # in which model and watcher hold each other, and all worlds, until garbage is collected
    _check_finite(model, run)
    save_checkpoint(run, model, "policy.zip", "replay.npz")
    run.note_pace(
        model.num_timesteps,
        clock.seconds,
        finished=True,
        compile_seconds=environment.env.race.simulator.compile_seconds,
    )
    return run


def _make_logger(folder: Path, begun_at: int) -> Logger:
    """A log that has its readers pass over what was noted beyond the steps that a run goes on from: it comes again."""
    from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # type: ignore[attr-defined]

    output = TensorBoardOutputFormat(str(folder))
    assert output.writer.file_writer is not None
    # In the log's own file: of two that were begun in one second, readers may take either first.
    output.writer.file_writer.add_event(Event(step=begun_at + 1, session_log=SessionLog(status=SessionLog.START)))
    return Logger(str(folder), [output])


def _save(run: Run, model: Any, clock: Stopwatch) -> None:
    """A checkpoint."""
    name = f"checkpoints/step_{model.num_timesteps:09d}"
    save_checkpoint(run, model, f"{name}.zip", f"{name}.npz")
    run.note_pace(model.num_timesteps, clock.seconds)


def _seed_stint(model: Any, config: TrainingConfig) -> None:
    """Let all that is random from here on follow from the run's seed and the steps so far.

    A stint is what is trained from one checkpoint to the next. Each begins with new episodes, and depends on nothing
    but the checkpoint: a training that is resumed there is, bit for bit, the one that was never stopped.
    """
    model.set_random_seed(int(np.random.SeedSequence([config.seed, model.num_timesteps]).generate_state(1)[0]))


def _begin_episodes(model: Any) -> None:
    """Begin one in every world, as `learn` does where it resumes a training."""
    model._last_obs = model.env.reset()
    model._last_episode_starts = np.ones(model.n_envs, bool)
    replay = getattr(model, "replay_buffer", None)
    if replay is not None:
        replay.begin_all(model.env, model._last_obs)


def _newest_model(run: Run, environment, config: TrainingConfig):
    """The newest checkpoint that can be read; None where there is none. Raises OutlapError where none can be read."""
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
                log.warning("%s; the training goes on with an empty one", error)
        return model
    if error is not None:
        raise OutlapError(f"{error}; nor can those before; remove {run.folder}/checkpoints to begin anew") from error
    return None


def _check_finite(model: Any, run: Run) -> None:
    """Raise TrainingDiverged for a network that has diverged, before it drives or is saved."""
    for name, parameter in model.policy.named_parameters():
        if not (parameter.abs() < LARGEST_WEIGHT).all():  # nor is NaN
            kept = run.checkpoints()
            last = f"the last good checkpoint is {kept[0]}" if kept else "there is no checkpoint yet"
            raise TrainingDiverged(
                f"{run.folder}: the training diverged: {name} is NaN or beyond {LARGEST_WEIGHT:g} after "
                f"{model.num_timesteps:,} steps; {last}; train anew with a lower --learning-rate"
            )


def _watcher(run: Run, config: TrainingConfig, clock: Stopwatch, on_progress: Callable[[Progress], None] | None):
    from stable_baselines3.common.callbacks import BaseCallback

    class Watcher(BaseCallback):
        """Logs episodes by outcome and reward term; writes checkpoints; reports progress."""

        def _on_training_start(self) -> None:
            self.saved_at = self.reported_at = self.model.num_timesteps

        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:
            # Here, and not where a rollout ends: by now the policy has learnt from all that it has seen.
            _check_finite(self.model, run)
            steps = self.model.num_timesteps
            if steps - self.saved_at >= config.checkpoint_every:
                self.logger.dump(steps)  # what is noted so far belongs to this stint
                _save(run, self.model, clock)
                self.saved_at = self.reported_at = steps
                _seed_stint(self.model, config)
                _begin_episodes(self.model)

        def _on_rollout_end(self) -> None:
            if self.model.num_timesteps - self.reported_at < config.report_every:
                return
            self.reported_at = self.model.num_timesteps
            episodes = self.model.ep_info_buffer or []
            terms = [name for name in episodes[-1] if name.startswith("reward_")] if episodes else []
            numbers = {
                name: float(np.mean([episode[name] for episode in episodes]))
                for name in ("progress_m", "mean_speed_mps", "completed_laps", "episode_return", *terms)
                if episodes
            }
            for name, number in numbers.items():
                self.logger.record(f"race/{name}", number)
            crash_rate = None
            if episodes:
                crash_rate = float(np.mean([episode["outcome"] == CRASH for episode in episodes]))
                self.logger.record("race/crash_rate", crash_rate)
            steps = self.model.num_timesteps
            if on_progress is not None:
                on_progress(
                    Progress(
                        steps=steps,
                        total_steps=config.total_steps,
                        steps_per_second=steps / clock.seconds,
                        crash_rate=crash_rate,
                        mean_speed_mps=numbers.get("mean_speed_mps"),
                        progress_m=numbers.get("progress_m"),
                    )
                )

    return Watcher()
