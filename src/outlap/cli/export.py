"""`outlap export`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult, check_output_path
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console

LARGEST_DIFFERENCE = 1e-5  # of an action, between the file and the policy


@dataclass(frozen=True)
class Export(LongCommand):
    """Write a trained policy as one ONNX file for a car, and check that it does what the policy does.

    Scaling, history, networks and what actions mean are inside; `outlap.deploy.CarDriver` drives with it.
    """

    run_folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `outlap train`."""

    out: Path | None = None
    """The file; by default RUN/policy.onnx."""

    steps: int = 1000
    """Actions of a race in the training's environment on which both are compared."""

    def run(self) -> CommandResult:
        from outlap.deploy.car_driver import CarDriver
        from outlap.deploy.export import compare, export_policy
        from outlap.training.run import load_run

        check_least("--steps", self.steps, 1)
        path = self.out or self.run_folder / "policy.onnx"
        check_output_path(path, (".onnx",))
        run = load_run(self.run_folder)
        with self.progress("exporting", self.steps, "steps compared") as update:
            facts = export_policy(run, path)
            of_action, of_command = compare(
                run, CarDriver(path), self.steps, on_step=lambda done: update(done, "") if done % 50 == 0 else None
            )
        if not of_action <= LARGEST_DIFFERENCE or math.isnan(of_command):  # NaN is not either
            path.unlink()
            raise OutlapError(
                f"{run.folder}: the file differs from the policy by {of_action:.2g} in its actions and "
                f"{of_command:.2g} in its commands; please report this"
            )
        data = {
            "file": path, "bytes": path.stat().st_size, "steps_compared": self.steps,
            "largest_action_difference": of_action, "largest_command_difference": of_command, **facts,
        }  # fmt: skip

        def show(console: Console) -> None:
            lines = (
                f"{path} ({data['bytes'] / 1e6:.2f} MB)",
                f"takes {', '.join(facts['terms'])}: {facts['beams']} beams over {facts['field_of_view']:.2f} rad, "
                f"every {1000 * facts['interval_s']:.0f} ms",
                f"on {self.steps:,} steps no action differs from the policy's by more than {of_action:.1g}",
            )
            for line in lines:
                console.print(line)

        return CommandResult(data, show)
