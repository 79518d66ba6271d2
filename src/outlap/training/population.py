"""Training a population of opponents: one PPO policy for every top speed, verified before it may race.

Each policy is trained in a process of its own on one core: on several cores this is nearly as many times faster as
there are cores, where the threads of one training gain little.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.sharedctypes import SynchronizedArray
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import MANIFEST, Member, Split, file_hashes, read_manifest, write_manifest
from outlap.envs.race_config import RaceConfig
from outlap.envs.rewards import RewardConfig
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.evaluation.rollout import evaluate, made_for, standing_starts
from outlap.processes import process_environment
from outlap.track.track import Track
from outlap.training.ppo import PPOConfig
from outlap.training.run import load_run
from outlap.training.session import train

SLOWEST = 0.5  # [m/s] that an opponent can command; one that may stop would rather stand than enter a corner
POLL = 0.5  # [s] between two looks at how far the trainings are


@dataclass(frozen=True)
class Opponent:
    """An opponent that is to be trained."""

    name: str
    max_speed_mps: float
    split: Split


@dataclass(frozen=True)
class Plan:
    """A population that is to be trained; the same plan goes on where it was stopped."""

    settings: PPOConfig
    folder: Path
    track: Track
    track_name: str  # as `Track.load` finds it
    opponents: Sequence[Opponent]
    laps: int  # consecutive ones that an opponent must complete from every start
    starts: int
    command: str  # for the manifest


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


def train_population(
    plan: Plan, jobs: int = 0, on_progress: Callable[[int, str], None] | None = None
) -> Iterator[tuple[Opponent, pd.DataFrame, bool]]:
    """Train and verify every opponent of a plan, and enter those that pass into the manifest.

    Args:
        plan: what to train.
        jobs: trainings at a time; 0: one a core.
        on_progress: called now and then with the steps of all trainings together, and a note.

    Yields:
        Each opponent when it is done, the rows of its verification, and whether it passed.

    Raises OutlapError for a folder that holds trainings of another plan, and what `train` raises. A KeyboardInterrupt
    passes through once every training has written a checkpoint.
    """
    cores = os.cpu_count() or 1
    jobs = min(jobs or cores, len(plan.opponents))
    for opponent in plan.opponents:  # before the first training, and not hours later
        _begun(plan, opponent)
    context = multiprocessing.get_context("spawn")
    steps, stop = context.Array("q", len(plan.opponents)), context.Event()
    threads = max(1, cores // jobs)
    with process_environment(NUMBA_NUM_THREADS=str(threads), OMP_NUM_THREADS=str(threads)):
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(steps, stop, threads))
        # No more at a time than workers: those that wait in the pool could not be taken back.
        running: dict[Future[pd.DataFrame], int] = {}
        waiting = list(range(len(plan.opponents)))
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    number = waiting.pop(0)
                    running[pool.submit(_train_and_verify, plan, number)] = number
                done, _ = wait(running, POLL, FIRST_COMPLETED)
                if on_progress is not None:
                    names = ", ".join(plan.opponents[number].name for number in sorted(running.values()))
                    on_progress(sum(steps[:]), names)
                for future in done:
                    opponent = plan.opponents[running.pop(future)]
                    rows = future.result()
                    yield opponent, rows, _enter(plan, opponent, rows) is not None
        finally:
            stop.set()  # after an error or Ctrl-C, those that still train save and go
            pool.shutdown(wait=True)


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
            name=opponent.name,
            max_speed_mps=opponent.max_speed_mps,
            split=opponent.split,
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


def _enter(plan: Plan, opponent: Opponent, rows: pd.DataFrame) -> Member | None:
    return enter(plan.folder, opponent, rows, plan.track.name, plan.laps, plan.command)


def _begun(plan: Plan, opponent: Opponent):
    """The run of an opponent whose training was begun, or None. Raises OutlapError for one of another plan."""
    folder = plan.folder / "runs" / opponent.name
    if not (folder / "config.yaml").is_file():
        return None
    run = load_run(folder)
    if run.config != opponent_config(plan.settings, plan.track_name, opponent.max_speed_mps):
        raise OutlapError(f"{folder}: was begun with another configuration; take another --out, or remove it")
    return run


_steps: SynchronizedArray | None = None  # of every training, shared by the processes of a pool
_stop: Event | None = None  # set when all trainings are to end, shared likewise


def _start_worker(steps: Any, stop: Event, threads: int) -> None:
    global _steps, _stop
    import torch

    _steps, _stop = steps, stop
    torch.set_num_threads(threads)


def _train_and_verify(plan: Plan, number: int) -> pd.DataFrame:
    """Train one opponent, or go on with its training, and leave its files in the population's folder: in a worker."""
    parent = multiprocessing.parent_process()

    def on_steps(steps: int) -> None:
        if _steps is not None:
            _steps[number] = steps
        if (_stop is not None and _stop.is_set()) or (parent is not None and not parent.is_alive()):
            raise KeyboardInterrupt  # nobody waits for this any more: save and go

    try:
        return train_opponent(plan, plan.opponents[number], on_steps)
    except KeyboardInterrupt:
        if parent is not None and not parent.is_alive():
            os._exit(1)
        raise


def train_opponent(plan: Plan, opponent: Opponent, on_steps: Callable[[int], None]) -> pd.DataFrame:
    """Train one opponent, or go on with its training, and leave its files in the plan's folder.

    Args:
        plan: of the population.
        opponent: of the plan.
        on_steps: called with the steps so far; may raise KeyboardInterrupt, which passes through once a checkpoint is
            written.

    Returns:
        The rows of its verification.
    """
    config = opponent_config(plan.settings, plan.track_name, opponent.max_speed_mps)
    run = train(
        config,
        plan.folder / "runs" / opponent.name,
        resume=_begun(plan, opponent),
        on_progress=lambda progress: on_steps(progress.steps),
    )
    on_steps(config.total_steps)
    from stable_baselines3 import PPO

    driver = MLPDriver.from_ppo(
        PPO.load(run.policy_path, device="cpu"), opponent.name, config.env.scale_observations,
        (SLOWEST, opponent.max_speed_mps),
    )  # fmt: skip
    driver.save(plan.folder / opponent.name)
    return verify(driver, plan.settings.env, plan.track, plan.laps, plan.starts)
