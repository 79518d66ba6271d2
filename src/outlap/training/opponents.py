"""Opponents: one PPO policy for every top speed, verified before it may enter a population."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import MANIFEST, Member, Split, file_hashes, read_manifest, write_manifest
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.envs.terminations import CRASH
from outlap.evaluation.protocol import made_for, standing_starts
from outlap.evaluation.rollout import evaluate
from outlap.track.track import Track
from outlap.training.model_file import load_model
from outlap.training.ppo import PPOConfig
from outlap.training.run import is_run, load_run
from outlap.training.session import train

SLOWEST = 0.5  # [m/s] that an opponent can command; one that may stop would rather stand than enter a corner


@dataclass(frozen=True)
class Opponent:
    """An opponent that is to be trained."""

    name: str
    max_speed_mps: float
    split: Split


def opponent_defaults() -> PPOConfig:
    """What an opponent is trained with unless flags say otherwise: the paper's rewards and number of steps."""
    base = PPOConfig()
    env = base.env.model_copy(update={"reward": RewardConfig(preset="paper")})
    return base.model_copy(update={"env": env, "total_steps": 3_000_000})


def opponent_config(base: PPOConfig, track: str, max_speed: float) -> PPOConfig:
    """The training of one opponent: alone on a track, up to its top speed."""
    vehicle = base.env.vehicle.model_copy(update={"v_max": max_speed})
    env = base.env.model_copy(
        update={"tracks": (track,), "vehicle": vehicle, "speed_range": (SLOWEST, max_speed), "num_cars": 1}
    )
    return base.model_copy(update={"env": env})


def verify(driver: MLPDriver, env: RaceConfig, track: Track, laps: int, starts: int, seed: int = 0) -> pd.DataFrame:
    """Rows of an opponent's runs alone, from standing starts anywhere on the lap until its laps are done."""
    alone = made_for(driver, env.model_copy(update={"num_cars": 1}))
    return evaluate(driver, standing_starts(alone, [track], laps), [track], starts, seed, lap_time_ratios=False)


def enter(folder: Path, opponent: Opponent, rows: pd.DataFrame, track: str, laps: int, command: str) -> Member | None:
    """Put a verified opponent into the manifest; one that failed is taken out of it, and None is returned."""
    there = read_manifest(folder, may_be_empty=True) if (folder / MANIFEST).is_file() else ()
    others = [member for member in there if member.name != opponent.name]
    completed = rows["completed_laps"].to_numpy()
    member = None
    if (completed >= laps).all():
        member = Member(
            **vars(opponent),
            track=track,
            verified_laps=int(completed.min()),
            crash_rate=crash_rate(rows),
            lap_time_s=float(rows["lap_time_s"].to_numpy().mean()),
            command=command,
            sha256=file_hashes(folder, opponent.name),
        )
    write_manifest(folder, [*others, *([member] if member else [])])
    return member


def crash_rate(rows: pd.DataFrame) -> float:
    """Of an opponent's verification."""
    return float(np.mean(rows["outcome"].to_numpy() == CRASH))


def train_opponent(
    opponent: Opponent, settings: PPOConfig, track: str, folder: Path, on_steps: Callable[[int], None]
) -> MLPDriver:
    """Train an opponent, or resume its training.

    Args:
        opponent: which.
        settings: of the trainings of all opponents.
        track: name that `load_track` finds it by.
        folder: of the run.
        on_steps: called with the steps so far; may raise KeyboardInterrupt, which passes through once a checkpoint is
            written.

    Returns:
        Its driver, not verified yet.
    """
    config = opponent_config(settings, track, opponent.max_speed_mps)
    begun = load_run(folder) if is_run(folder) else None
    run = train(config, folder, resume=begun, on_progress=lambda progress: on_steps(progress.steps))
    model: Any = load_model(run.config, run.policy_path)
    speeds = SLOWEST, opponent.max_speed_mps
    return MLPDriver.from_ppo(model, opponent.name, config.env.scale_observations, speeds)
