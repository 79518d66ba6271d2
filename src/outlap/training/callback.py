"""The callback of every training: statistics of episodes, checkpoints, progress."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback

from outlap.envs.episodes import EPISODE_FIELDS, REWARD_PREFIX
from outlap.envs.terminations import CRASH
from outlap.training.checkpoints import begin_episodes, check_finite, reseed, save_progress
from outlap.training.config import TrainingConfig
from outlap.training.run import Run

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


@dataclass(frozen=True)
class Progress:
    """Progress of a training."""

    steps: int
    total_steps: int
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


def advance_curricula(model: BaseAlgorithm, total_steps: int) -> None:
    """Tell the environment of a model which share of the training is done."""
    environment = model.get_env()
    assert environment is not None
    environment.set_attr("training_progress", min(1.0, model.num_timesteps / total_steps))


class CurriculumCallback(BaseCallback):
    """For trainings with Stable-Baselines3 alone: let reward curricula follow the progress of `learn`."""

    def _on_rollout_start(self) -> None:
        advance_curricula(self.model, self.model._total_timesteps)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        advance_curricula(self.model, self.model.num_timesteps)


class TrainingCallback(BaseCallback):
    """Log episodes by outcome and reward term, write checkpoints, report progress."""

    def __init__(
        self, run: Run, config: TrainingConfig, clock: Stopwatch, on_progress: Callable[[Progress], None] | None
    ) -> None:
        super().__init__()
        self._run, self._config, self._clock, self._on_progress = run, config, clock, on_progress

    def _on_training_start(self) -> None:
        self._saved_at = self._reported_at = self.model.num_timesteps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # Here, and not where a rollout ends: by now the policy has learnt from all that it has seen.
        check_finite(self.model, self._run)
        steps = self.model.num_timesteps
        if steps - self._saved_at >= self._config.checkpoint_every:
            self.logger.dump(steps)  # what is noted so far belongs before the checkpoint
            save_progress(self._run, self.model, self._clock.seconds)
            self._saved_at = self._reported_at = steps
            reseed(self.model, self._config)
            begin_episodes(self.model)
        advance_curricula(self.model, self._config.total_steps)

    def _on_rollout_end(self) -> None:
        steps = self.model.num_timesteps
        if steps - self._reported_at < self._config.report_every:
            return
        self._reported_at = steps
        numbers = self._episode_statistics()
        for name, number in numbers.items():
            self.logger.record(f"race/{name}", number)
        if self._on_progress is not None:
            self._on_progress(
                Progress(
                    steps=steps,
                    total_steps=self._config.total_steps,
                    crash_rate=numbers.get("crash_rate"),
                    mean_speed_mps=numbers.get("mean_speed_mps"),
                    progress_m=numbers.get("progress_m"),
                )
            )

    def _episode_statistics(self) -> dict[str, float]:
        """Means over recent episodes, by name; empty before the first one ended."""
        episodes = pd.DataFrame(list(self.model.ep_info_buffer or ()))
        if episodes.empty:
            return {}
        logged = [name for name in episodes if name in EPISODE_FIELDS or str(name).startswith(REWARD_PREFIX)]
        means = episodes[logged].mean().dropna()  # a lap time is known after a lap
        return {**means.to_dict(), "crash_rate": float(np.mean(np.asarray(episodes["outcome"] == CRASH)))}
