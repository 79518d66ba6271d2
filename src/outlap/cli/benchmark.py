"""`outlap benchmark simulator` and `outlap benchmark mql`."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult
from outlap.errors import OutlapError
from outlap.processes import in_new_process
from outlap.provenance import machine
from outlap.training.config import check_device

if TYPE_CHECKING:
    from rich.console import Console

CASES = ((1, 108), (1, 540), (1, 1080), (2, 540))  # cars, beams
HOLD = 10  # physics steps that a random command is held
PLANS = 64  # random commands and starts made beforehand


@dataclass(frozen=True)
class BenchmarkSimulator(LongCommand):
    """Measure physics steps with their scans per second, every core at work.

    Random driving: each car holds a steering angle within 0.2 rad and a speed within 8 m/s for 10 steps. A
    world whose first car crashed is reset, and the time for that counts. An env-step is one physics step of a world.
    """

    worlds: int = 256
    """Worlds in lock-step."""

    cars: int | None = None
    """Cars a world; with --beams one case in place of the usual four."""

    beams: int | None = None
    """LiDAR beams."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; the built-in training circuits by default."""

    model: Literal["kinematic", "single_track", "drift"] = "single_track"
    """Vehicle model."""

    integrator: Literal["euler", "rk4"] = "rk4"
    """Integrator."""

    seconds: float = 5.0
    """How long each case is measured."""

    repeats: int = 3
    """Measurements of each case; the median is reported, with the fastest and the slowest."""

    def run(self) -> CommandResult:
        if (self.cars is None) != (self.beams is None):
            raise OutlapError("--cars and --beams go together: give both for one case, or neither for the usual four")
        if self.worlds < 1 or self.seconds <= 0 or self.repeats < 1:
            raise OutlapError("--worlds and --repeats must be at least 1 and --seconds more than 0")
        cases = CASES if self.cars is None or self.beams is None else ((self.cars, self.beams),)
        rows = []
        with self.progress("benchmark", len(cases), "cases") as update:
            for cars, beams in cases:
                # A process of its own each, so that its peak of memory is its own.
                rows.append(in_new_process(_measure, self, cars, beams))
                update(len(rows), f"{cars} car(s), {beams} beams")
        from numba import get_num_threads

        data = {
            "rows": rows,
            "model": self.model,
            "integrator": self.integrator,
            "timestep_s": 0.01,
            "threads": get_num_threads(),
            "machine": machine(),
        }
        return CommandResult(data, lambda console: _print(console, rows))


def _measure(settings: BenchmarkSimulator, cars: int, beams: int) -> dict[str, Any]:
    import numpy as np

    from outlap.simulator.collision import FREE
    from outlap.simulator.simulator import Simulator, SimulatorConfig
    from outlap.simulator.vehicle import VehicleParams, parameter_bounds, to_records
    from outlap.track.catalog import load_tracks
    from outlap.track.generate import BUILTIN_TRAIN

    tracks = load_tracks(settings.tracks or BUILTIN_TRAIN)
    worlds = settings.worlds
    config = SimulatorConfig(beams=beams, model=settings.model, integrator=settings.integrator)
    simulator = Simulator(tracks, worlds, cars, config)
    rng = np.random.default_rng(0)
    lengths = np.array([track.centerline.length for track in tracks])
    row, _ = parameter_bounds(VehicleParams())
    commands = np.stack(
        [rng.uniform(-0.2, 0.2, (PLANS, worlds, cars)), rng.uniform(0.0, 8.0, (PLANS, worlds, cars))], axis=-1
    ).astype(np.float32)
    track = rng.integers(len(tracks), size=(PLANS, worlds)).astype(np.int32)
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
    for _ in range(settings.repeats):
        steps, begin = 0, time.perf_counter()
        while time.perf_counter() - begin < settings.seconds:
            drive(steps, HOLD)
            steps += HOLD
        rates.append(steps * worlds / (time.perf_counter() - begin))
    return {
        "cars": cars,
        "beams": beams,
        "worlds": worlds,
        "tracks": len(tracks),
        "env_steps_per_second": round(float(np.median(rates))),
        "slowest_env_steps_per_second": round(min(rates)),
        "fastest_env_steps_per_second": round(max(rates)),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "compile_s": round(simulator.compile_seconds or 0.0, 2),
    }


def _print(console: Console, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(title="simulator: physics steps with scans")
    for heading in ("cars", "beams", "worlds", "env-steps/s", "slowest … fastest", "peak memory [MB]", "compile [s]"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            str(row["cars"]),
            str(row["beams"]),
            str(row["worlds"]),
            f"{row['env_steps_per_second']:,}",
            f"{row['slowest_env_steps_per_second']:,} … {row['fastest_env_steps_per_second']:,}",
            f"{row['peak_memory_mb']:,.0f}",
            f"{row['compile_s']:.1f}",
        )
    console.print(table)
    console.print("compile: what the kernels' first call took; the result is cached on disk", style="dim")


MQL_BEAMS = {"paper": 540, "fast": 108}  # of a preset
MQL_WORLDS = 128
FILLED = 60  # actions of every world in the replay before anything is measured


@dataclass(frozen=True)
class BenchmarkMQL(LongCommand):
    """Measure updates of Meta-Q-Learning, and a training as a whole.

    `update_ms` is the time of one update: a batch gathered from the replay, both losses, every second time the
    actor's. `env_steps_per_second` is the pace of a training with one update for an action of all 128 worlds.
    """

    preset: Literal["fast", "paper"] | None = None
    """Networks; both by default."""

    beams: int | None = None
    """LiDAR beams; by default 540 with the preset `paper` and 108 with `fast`."""

    batch: int = 256
    """Transitions of an update."""

    updates: int = 40
    """Updates of a measurement."""

    repeats: int = 3
    """Measurements of each case; the median is reported, with the fastest and the slowest."""

    device: str = "cpu"
    """Of the networks: cpu, cuda, cuda:1, or auto for a GPU if there is one."""

    def run(self) -> CommandResult:
        if self.batch < 2 or (self.beams is not None and self.beams < 1):
            raise OutlapError("--batch must be at least 2 and --beams at least 1")
        if self.updates < 2 or self.repeats < 1:
            raise OutlapError("--updates must be at least 2 and --repeats at least 1")
        check_device(self.device)
        presets = MQL_BEAMS if self.preset is None else (self.preset,)
        rows = []
        with self.progress("benchmark", len(presets), "cases") as update:
            for preset in presets:
                beams = self.beams or MQL_BEAMS[preset]
                rows.append(in_new_process(_measure_mql, self, preset, beams, self.batch))
                update(len(rows), f"{preset}, {beams} beams, batch {self.batch}")
        data = {"rows": rows, "device": self.device, "machine": machine()}
        return CommandResult(data, lambda console: _print_mql(console, rows))


def mql_with_replay(preset: str, beams: int, batch: int, device: str = "cpu") -> Any:
    """An MQL in worlds of its own, whose replay is filled."""
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


def _measure_mql(settings: BenchmarkMQL, preset: str, beams: int, batch: int) -> dict[str, Any]:
    import numpy as np

    model = mql_with_replay(preset, beams, batch, settings.device)
    updates, rates = [], []
    for _ in range(settings.repeats):
        begin = time.perf_counter()
        model.train(settings.updates, batch)
        updates.append(1e3 * (time.perf_counter() - begin) / settings.updates)
        begin = time.perf_counter()
        model.learn(settings.updates * MQL_WORLDS, reset_num_timesteps=False)
        rates.append(settings.updates * MQL_WORLDS / (time.perf_counter() - begin))
    return {
        "preset": preset,
        "beams": beams,
        "batch": batch,
        "update_ms": round(float(np.median(updates)), 2),
        "fastest_update_ms": round(min(updates), 2),
        "slowest_update_ms": round(max(updates), 2),
        "env_steps_per_second": round(float(np.median(rates))),
    }


def _print_mql(console: Console, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(title="Meta-Q-Learning: updates, and trainings with one update for an action of 128 worlds")
    for heading in ("preset", "beams", "batch", "update [ms]", "fastest … slowest", "env-steps/s"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["preset"],
            str(row["beams"]),
            str(row["batch"]),
            f"{row['update_ms']:.1f}",
            f"{row['fastest_update_ms']:.1f} … {row['slowest_update_ms']:.1f}",
            f"{row['env_steps_per_second']:,}",
        )
    console.print(table)
