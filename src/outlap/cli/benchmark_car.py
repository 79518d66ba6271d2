"""`outlap benchmark car`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult
from outlap.provenance import machine

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class BenchmarkCar(LongCommand):
    """Measure how long an exported policy takes for a command, from a raw scan of 1,081 ranges, on one core."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Of `outlap export`."""

    commands: int = 5_000
    """To measure."""

    def run(self) -> CommandResult:
        from outlap.deploy.car_driver import CarDriver

        check_least("--commands", self.commands, 100)
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

        def show(console: Console) -> None:
            words = ", ".join(f"{name.removesuffix('_ms')} {value} ms" for name, value in milliseconds.items())
            console.print(f"{words}, of {self.commands:,} commands")

        return CommandResult(data, show)


QUANTILES = {"median_ms": 0.5, "p99_ms": 0.99, "p999_ms": 0.999}
