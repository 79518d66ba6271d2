"""Measure the throughput of the simulator and of Meta-Q-Learning."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from outlap.simulator.collision import FREE
from outlap.simulator.simulator import Simulator, SimulatorConfig
from outlap.simulator.vehicle import VehicleParams, parameter_bounds, to_records
from outlap.track.catalog import load_tracks
from outlap.track.generate import BUILTIN_TRAIN

HOLD = 10  # physics steps that a random command is held
PLANS = 64  # random commands and starts made beforehand
MQL_WORLDS = 128
FILLED = 60  # actions of every world in the replay before anything is measured


def simulator_throughput(
    config: SimulatorConfig, tracks: Sequence[str], worlds: int, cars: int, seconds: float, repeats: int
) -> dict[str, Any]:
    """Return physics steps with scans per second of random driving, the peak of memory and the time to compile.

    Args:
        config: of the simulator.
        tracks: names or map folders; if empty, the built-in training circuits.
        worlds, cars: in lock-step, and in each world.
        seconds, repeats: of each measurement, and how many there are; the median is reported.
    """
    loaded = load_tracks(tracks or BUILTIN_TRAIN)
    simulator = Simulator(loaded, worlds, cars, config)
    rng = np.random.default_rng(0)
    lengths = np.array([track.centerline.length for track in loaded])
    row, _ = parameter_bounds(VehicleParams())
    commands = np.stack(
        [rng.uniform(-0.2, 0.2, (PLANS, worlds, cars)), rng.uniform(0.0, 8.0, (PLANS, worlds, cars))], axis=-1
    ).astype(np.float32)
    track = rng.integers(len(loaded), size=(PLANS, worlds)).astype(np.int32)
    keys = rng.integers(2**63, size=(PLANS, worlds), dtype=np.uint64)
    starts = np.zeros((PLANS, worlds, cars, 4))
    starts[..., 0] = (rng.random((PLANS, worlds)) * lengths[track])[..., None] - 2.0 * np.arange(cars)
    starts[..., 3] = 3.0
    params = np.full((worlds, cars), to_records(row))

    def reset(which: np.ndarray, plan: int) -> None:
        simulator.reset(
            which, keys=keys[plan, which], tracks=track[plan, which], params=params[: len(which)],
            starts=starts[plan, which],
        )  # fmt: skip

    def drive(first: int, steps: int) -> None:
        for step in range(first, first + steps):
            simulator.step(commands[step // HOLD % PLANS])
            crashed = np.flatnonzero(simulator.worlds.contact[:, 0] != FREE)
            if len(crashed):
                reset(crashed, step % PLANS)

    reset(np.arange(worlds), 0)
    drive(0, 2 * HOLD)
    rates = []
    for _ in range(repeats):
        steps, begin = 0, time.perf_counter()
        while time.perf_counter() - begin < seconds:
            drive(steps, HOLD)
            steps += HOLD
        rates.append(steps * worlds / (time.perf_counter() - begin))
    return {
        "cars": cars,
        "beams": config.beams,
        "worlds": worlds,
        "tracks": len(loaded),
        "env_steps_per_second": round(float(np.median(rates))),
        "slowest_env_steps_per_second": round(min(rates)),
        "fastest_env_steps_per_second": round(max(rates)),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "compile_s": round(simulator.compile_seconds or 0.0, 2),
    }


def mql_with_replay(preset: str, beams: int, batch: int, device: str = "cpu") -> Any:
    """Return an MQL in worlds of its own, whose replay is filled."""
    # Deferred: measurements of the simulator report their peak of memory, without PyTorch.
    from outlap.envs.race_vector_env import RaceVectorEnv
    from outlap.envs.sb3_vec_env import SB3VecEnv
    from outlap.training.mql import MQLConfig

    terms = ("scan", "pose", "vel", "heading", "previous_reward")
    env = MQLConfig().env.model_copy(update={"beams": beams, "observation": terms, "augment_tracks": False})
    config = MQLConfig.model_validate(
        {
            "env": env, "preset": preset, "batch_size": batch, "device": device, "num_envs": MQL_WORLDS,
            "n_steps": 1, "updates_per_step": 1, "learning_starts": FILLED * MQL_WORLDS,
            "buffer_size": 1000 * MQL_WORLDS,
        }
    )  # fmt: skip
    model: Any = config.make_model(SB3VecEnv(RaceVectorEnv(MQL_WORLDS, env)))
    model.learn((FILLED + 4) * MQL_WORLDS)
    return model


def mql_throughput(preset: str, beams: int, batch: int, device: str, updates: int, repeats: int) -> dict[str, Any]:
    """Return the time of an update, and env-steps per second of a training with one update for each action.

    Args:
        preset, beams, batch, device: see `MQLConfig`; batch in transitions.
        updates, repeats: of each measurement, and how many there are; the median is reported.
    """
    model = mql_with_replay(preset, beams, batch, device)
    times, rates = [], []
    for _ in range(repeats):
        begin = time.perf_counter()
        model.train(updates, batch)
        times.append(1e3 * (time.perf_counter() - begin) / updates)
        begin = time.perf_counter()
        model.learn(updates * MQL_WORLDS, reset_num_timesteps=False)
        rates.append(updates * MQL_WORLDS / (time.perf_counter() - begin))
    return {
        "preset": preset,
        "beams": beams,
        "batch": batch,
        "update_ms": round(float(np.median(times)), 2),
        "fastest_update_ms": round(min(times), 2),
        "slowest_update_ms": round(max(times), 2),
        "env_steps_per_second": round(float(np.median(rates))),
    }
