"""PPO with domain randomization: Stable-Baselines3's PPO on the batched environment."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from outlap.config import Config
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.tasks import TaskSet, TaskSplit, load_tracks
from outlap.envs.terminations import CRASH, TerminationConfig
from outlap.simulator.vehicle import LidarParams, VehicleParams
from outlap.training.run import Run, create_run, save_checkpoint

RECENT_EPISODES = 500  # over which training statistics are taken


class PPOConfig(Config):
    """A PPO training. The defaults learn to lap circuits that they never saw within minutes on two cores."""

    env: RaceConfig = RaceConfig(
        augment_tracks=True,
        beams=108,
        control_interval=4,
        speed_range=(1.0, None),  # a car that may stop would rather stand than enter a corner it does not know
        vehicle=VehicleParams(v_max=8.0),
        lidar=LidarParams(noise_std=0.02),
        observation=("scan", "vel", "heading", "previous_action"),
        scale_observations=True,
        termination=TerminationConfig(time_limit=40.0),
        start=StartConfig(speed=(0.0, 6.0), offset=0.8, heading_error=0.3),
    )
    held_out_tracks: tuple[str, ...] = ()  # what `outlap evaluate` takes by default; refused if also trained on
    total_steps: int = Field(default=2_000_000, gt=0)  # actions, all worlds together
    num_envs: int = Field(default=128, ge=1)
    seed: int = Field(default=0, ge=0)
    learning_rate: float = Field(default=5e-4, gt=0)
    learning_rate_decay: bool = True  # linearly to zero at total_steps
    n_steps: int = Field(default=64, ge=2)  # actions per world and rollout
    batch_size: int = Field(default=2048, ge=2)
    n_epochs: int = Field(default=5, ge=1)
    gamma: float = Field(default=0.99, gt=0, le=1)
    gae_lambda: float = Field(default=0.95, ge=0, le=1)
    clip_range: float = Field(default=0.2, gt=0)
    ent_coef: float = Field(default=0.0, ge=0)
    vf_coef: float = Field(default=0.5, ge=0)
    max_grad_norm: float = Field(default=0.5, gt=0)
    net_arch: tuple[int, ...] = (128, 128)  # of the policy, and of the value function
    activation: Literal["tanh", "relu"] = "tanh"
    log_std_init: float = -0.5  # log of the initial standard deviation of an action
    device: str = "cpu"
    threads: int = Field(default=0, ge=0)  # of PyTorch; 0 = one a core
    checkpoint_every: int = Field(default=250_000, gt=0)  # actions


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


def train_ppo(
    config: PPOConfig,
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
        on_progress: called after every rollout.

    Raises OutlapError for a track that cannot be loaded, a folder that holds a run. A KeyboardInterrupt
    passes through once a checkpoint is written.
    """
    if resume is not None and resume.finished:
        return resume
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import configure

    from outlap.envs.sb3_vec_env import SB3VecEnv

    if config.threads:
        torch.set_num_threads(config.threads)
    # Everything that can be wrong with the configuration is found here, before the folder is made.
    environment = SB3VecEnv(config.num_envs, **dict(config.env))
    if config.held_out_tracks:
        TaskSplit(environment.env.tasks, TaskSet(load_tracks(config.held_out_tracks)))
    run = resume or create_run(folder, config)
    if resume:
        run.begin_session()
    run.write_record(tracks={track.name: track.fingerprint for track in environment.env.tasks.tracks})
    model = _newest_model(run, environment, config) if resume else None
    if model is None:
        model = PPO(
            "MultiInputPolicy",
            environment,
            learning_rate=_schedule(config),
            n_steps=config.n_steps,
            batch_size=config.batch_size,
            n_epochs=config.n_epochs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            ent_coef=config.ent_coef,
            vf_coef=config.vf_coef,
            max_grad_norm=config.max_grad_norm,
            policy_kwargs={
                "net_arch": list(config.net_arch),
                "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[config.activation],
                "log_std_init": config.log_std_init,
            },
            seed=config.seed,
            device=config.device,
        )
    begun_at = model.num_timesteps
    environment.env.training_steps = begun_at
    # A resumed run must not race the episodes again that it has raced before.
    environment.seed(int(np.random.SeedSequence([config.seed, begun_at]).generate_state(1)[0]))
    model.set_logger(configure(str(run.folder / "tensorboard"), ["tensorboard"]))
    clock = Stopwatch(float(run.record().get("seconds", 0.0)) if begun_at else 0.0)
    try:
        if begun_at < config.total_steps:
            model.learn(
                config.total_steps - begun_at,
                callback=_watcher(run, config, clock, on_progress),
                reset_num_timesteps=begun_at == 0,
            )
    except KeyboardInterrupt:
        save_checkpoint(run, model, _checkpoint_name(model))
        run.note_pace(model.num_timesteps, clock.seconds)
        raise
    save_checkpoint(run, model, "policy.zip")
    run.note_pace(
        model.num_timesteps,
        clock.seconds,
        finished=True,
        compile_seconds=environment.env.race.simulator.compile_seconds,
    )
    return run


def _schedule(config: PPOConfig) -> Callable[[float], float] | float:
    if not config.learning_rate_decay:
        return config.learning_rate
    rate = config.learning_rate
    return lambda remaining: rate * remaining


def _checkpoint_name(model) -> str:
    return f"checkpoints/step_{model.num_timesteps:09d}.zip"


def _newest_model(run: Run, environment, config: PPOConfig):
    """The newest checkpoint that can be read, or None."""
    from stable_baselines3 import PPO

    for path in run.checkpoints():
        try:
            return PPO.load(path, env=environment, device=config.device)
        except Exception as error:  # whatever a broken file raises: the one before may be whole
            run.write_record(**{f"unreadable_{path.name}": str(error)})
    return None


def _watcher(run: Run, config: PPOConfig, clock: Stopwatch, on_progress: Callable[[Progress], None] | None):
    from stable_baselines3.common.callbacks import BaseCallback

    class Watcher(BaseCallback):
        """Logs episodes by outcome and reward term; writes checkpoints; reports progress."""

        def _on_training_start(self) -> None:
            self.episodes: deque[dict] = deque(maxlen=RECENT_EPISODES)
            self.saved_at = self.model.num_timesteps

        def _on_step(self) -> bool:
            self.episodes.extend(info for info in self.locals["infos"] if "episode" in info)
            return True

        def _on_rollout_start(self) -> None:
            # Here, and not where a rollout ends: by now the policy has learnt from all that it has seen.
            if self.model.num_timesteps - self.saved_at >= config.checkpoint_every:
                save_checkpoint(run, self.model, _checkpoint_name(self.model))
                run.note_pace(self.model.num_timesteps, clock.seconds)
                self.saved_at = self.model.num_timesteps

        def _on_rollout_end(self) -> None:
            numbers = {
                name: float(np.mean([episode[name] for episode in self.episodes]))
                for name in (
                    "progress_m",
                    "mean_speed_mps",
                    "completed_laps",
                    "episode_return",
                    *self._terms(),
                )
                if self.episodes
            }
            for name, number in numbers.items():
                self.logger.record(f"race/{name}", number)
            crash_rate = None
            if self.episodes:
                crash_rate = float(np.mean([episode["outcome"] == CRASH for episode in self.episodes]))
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

        def _terms(self) -> list[str]:
            return [name for name in self.episodes[-1] if name.startswith("reward_")] if self.episodes else []

    return Watcher()
