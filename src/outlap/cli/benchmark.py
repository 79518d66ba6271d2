"""`outlap benchmark simulator | mql | car`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, LongCommand, Positive, at_least
from outlap.cli.output import CommandResult, lines, table
from outlap.errors import OutlapError
from outlap.processes import in_new_process
from outlap.provenance import machine
from outlap.training.config import check_device

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

SIMULATOR_COLUMNS = {
    "cars": "{cars}", "beams": "{beams}", "worlds": "{worlds}", "env-steps/s": "{env_steps_per_second:,}",
    "slowest … fastest": "{slowest_env_steps_per_second:,} … {fastest_env_steps_per_second:,}",
    "peak memory [MB]": "{peak_memory_mb:,.0f}", "compile [s]": "{compile_s:.1f}",
}  # fmt: skip
CASES = ((1, 108), (1, 540), (1, 1080), (2, 540))  # cars, beams


@dataclass(frozen=True)
class BenchmarkSimulator(LongCommand):
    """Measure physics steps with their scans per second, every core at work.

    Random driving: each car holds a steering angle within 0.2 rad and a speed within 8 m/s for 10 steps. A
    world whose first car crashed is reset, and the time for that counts. An env-step is one physics step of a world.
    """

    worlds: Count = 256
    """Worlds in lock-step."""

    cars: int | None = None
    """Cars a world; with --beams one case in place of the usual four."""

    beams: int | None = None
    """LiDAR beams."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; the built-in training circuits by default."""

    model: Literal["kinematic", "single_track", "nonlinear_single_track", "drift"] = "single_track"
    """Vehicle model."""

    integrator: Literal["euler", "rk4"] = "rk4"
    """Integrator."""

    seconds: Positive = 5.0
    """How long each case is measured."""

    repeats: Count = 3
    """Measurements of each case; the median is reported, with the fastest and the slowest."""

    def run(self) -> CommandResult:
        from numba import get_num_threads

        from outlap.experiments.throughput import simulator_throughput
        from outlap.simulator.simulator import SimulatorConfig

        if (self.cars is None) != (self.beams is None):
            raise OutlapError("--cars and --beams go together: give both for one case, or neither for the usual four")
        cases = CASES if self.cars is None or self.beams is None else ((self.cars, self.beams),)
        rows = []
        with self.progress("benchmark", len(cases), "cases") as update:
            for cars, beams in cases:
                # A process of its own each, so that its peak of memory is its own.
                config = SimulatorConfig(beams=beams, model=self.model, integrator=self.integrator)
                settings = (config, self.tracks, self.worlds, cars, self.seconds, self.repeats)
                rows.append(in_new_process(simulator_throughput, *settings))
                update(len(rows), f"{cars} car(s), {beams} beams")
        data = {
            "rows": rows, "model": self.model, "integrator": self.integrator, "timestep_s": 0.01,
            "threads": get_num_threads(), "machine": machine(),
        }  # fmt: skip

        def show(console: Console) -> None:
            console.print(_table("simulator: physics steps with scans", SIMULATOR_COLUMNS, rows))
            console.print("compile: what the kernels' first call took; the result is cached on disk", style="dim")

        return CommandResult(data, show)


MQL_COLUMNS = {
    "preset": "{preset}", "beams": "{beams}", "batch": "{batch}", "update [ms]": "{update_ms:.1f}",
    "fastest … slowest": "{fastest_update_ms:.1f} … {slowest_update_ms:.1f}",
    "env-steps/s": "{env_steps_per_second:,}",
}  # fmt: skip
MQL_BEAMS = {"paper": 540, "fast": 108}  # of a preset


@dataclass(frozen=True)
class BenchmarkMQL(LongCommand):
    """Measure updates of Meta-Q-Learning, and a training as a whole.

    `update_ms` is the time of one update: a batch gathered from the replay, both losses, every second time the
    actor's. `env_steps_per_second` is the pace of a training with one update for an action of all 128 worlds.
    """

    preset: Literal["fast", "paper"] | None = None
    """Networks; both by default."""

    beams: Count | None = None
    """LiDAR beams; by default 540 with the preset `paper` and 108 with `fast`."""

    batch: int = 256
    """Transitions of an update."""

    updates: Annotated[int, at_least(2)] = 40
    """Updates of a measurement."""

    repeats: Count = 3
    """Measurements of each case; the median is reported, with the fastest and the slowest."""

    device: str = "cpu"
    """Of the networks: cpu, cuda, cuda:1, or auto for a GPU if there is one."""

    def run(self) -> CommandResult:
        from outlap.experiments.throughput import mql_throughput

        if self.batch < 2:
            raise OutlapError("--batch must be at least 2")
        check_device(self.device)
        presets = MQL_BEAMS if self.preset is None else (self.preset,)
        rows = []
        with self.progress("benchmark", len(presets), "cases") as update:
            for preset in presets:
                beams = self.beams or MQL_BEAMS[preset]
                settings = (preset, beams, self.batch, self.device, self.updates, self.repeats)
                rows.append(in_new_process(mql_throughput, *settings))
                update(len(rows), f"{preset}, {beams} beams, batch {self.batch}")
        data = {"rows": rows, "device": self.device, "machine": machine()}
        title = "Meta-Q-Learning: updates, and trainings with one update for an action of 128 worlds"
        return CommandResult(data, lambda console: console.print(_table(title, MQL_COLUMNS, rows)))


def _table(title: str, columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table of measurements; columns are headings and the formats of cells."""
    return table(list(columns), [[cell.format(**row) for cell in columns.values()] for row in rows], title=title)


QUANTILES = {"median_ms": 0.5, "p99_ms": 0.99, "p999_ms": 0.999}


@dataclass(frozen=True)
class BenchmarkCar(LongCommand):
    """Measure how long an exported policy takes for a command, from a raw scan of 1,081 ranges, on one core."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Of `outlap export`."""

    commands: Annotated[int, at_least(100)] = 5_000
    """To measure."""

    def run(self) -> CommandResult:
        import numpy as np

        from outlap.deploy.car_driver import CarDriver

        driver = CarDriver(self.file)
        rng = np.random.default_rng(0)
        scans = rng.uniform(0.5, 12.0, (64, 1081)).astype(np.float32)
        taken = np.empty(self.commands)
        with self.progress("benchmark", self.commands, "commands") as update:
            for number in range(-100, self.commands):  # the first ones warm up
                scan = scans[number % len(scans)]
                begun = time.perf_counter()
                command = driver.drive(scan, -2.356194, 0.00436332, (3.0, 0.1, 0.5))
                if number >= 0:
                    taken[number] = time.perf_counter() - begun
                if number % 100 == 99:
                    update(number + 1, command.reason)
        milliseconds = {name: round(1000.0 * float(np.quantile(taken, q)), 3) for name, q in QUANTILES.items()}
        data = {"file": self.file, "commands": self.commands, **milliseconds, "machine": machine()}
        words = ", ".join(f"{name.removesuffix('_ms')} {value} ms" for name, value in milliseconds.items())
        return CommandResult(data, lines(f"{words}, of {self.commands:,} commands"))
