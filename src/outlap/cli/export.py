"""`outlap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, LongCommand
from outlap.cli.output import CommandResult, check_output_path, lines


@dataclass(frozen=True)
class Export(LongCommand):
    """Write a trained policy as one ONNX file for a car, and check that it does what the policy does.

    Scaling, history, networks and what actions mean are inside; `outlap.deploy.CarDriver` drives with it.
    """

    run_folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `outlap train`."""

    out: Path | None = None
    """The file; by default RUN/policy.onnx."""

    steps: Count = 1000
    """Actions of a race in the training's environment on which both are compared."""

    def run(self) -> CommandResult:
        from outlap.deploy.export import export_and_compare
        from outlap.training.run import load_run

        path = self.out or self.run_folder / "policy.onnx"
        check_output_path(path, (".onnx",))
        run = load_run(self.run_folder)
        with self.progress("exporting", self.steps, "steps compared") as update:
            facts = export_and_compare(run, path, self.steps, on_step=lambda done: update(done, ""))
        of_action = facts["largest_action_difference"]
        data = {"file": path, "bytes": path.stat().st_size, "steps_compared": self.steps, **facts}

        show = lines(
            f"{path} ({data['bytes'] / 1e6:.2f} MB)",
            f"takes {', '.join(facts['terms'])}: {facts['beams']} beams over {facts['field_of_view']:.2f} rad, "
            f"every {1000 * facts['interval_s']:.0f} ms",
            f"on {self.steps:,} steps no action differs from the policy's by more than {of_action:.1g}",
        )
        return CommandResult(data, show)
