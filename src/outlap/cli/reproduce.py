"""`outlap reproduce`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, Flag
from outlap.cli.output import CommandResult, lines, table
from outlap.cli.work import WorkCommand, duration

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.experiments.unit import Unit


SHOWN = {"overtakes": "overtakes in 500", "crashes": "crashes in 500", "progress_m": "progress [m]"}


@dataclass(frozen=True)
class Reproduce(WorkCommand):
    """Make the paper's tables and figures: train what is missing, adapt, race, and write a report.

    Whatever is done is kept in --out: the same command goes on after a kill, and a changed configuration does anew
    only what depends on it. Real circuits are taken where they can be found, see `outlap tracks list`.
    """

    wanted: Annotated[Positional[tuple[str, ...]], arg(metavar="table-1|table-2|table-3|figure-2|appendix|all")]
    """What to make. Also vehicles, everything, and task sets of your own (.yaml)."""

    budget: str = "cpu"
    """How much of everything: smoke (minutes), cpu (three hours on two cores), paper (days), or a .yaml file."""

    methods: tuple[str, ...] = ()
    """Names or .yaml files; by default all that come with outlap."""

    seeds: Count | None = None
    """Trainings of every method, in place of the budget's."""

    out: Path | None = None
    """The folder for the report and the work; by default runs/reproduce-BUDGET."""

    driver_code: Flag = False
    """Import modules that a method's file names as its driver, module:function, which runs their code."""

    dry_run: Flag = False
    """Say what there is to do, and do nothing."""

    def run(self) -> CommandResult:
        from outlap.experiments.plan import make_plan
        from outlap.experiments.report import write_report

        self.check_flags()
        plan = make_plan(self.wanted, self.budget, self.methods, self.seeds, self.driver_code)
        folder = self.out or Path("runs") / f"reproduce-{plan.budget_name}"
        work = folder / "work"
        if self.dry_run:
            return _dry_run(plan.units, work, self.jobs or os.cpu_count() or 1)
        self.do_units(plan.units, work, "reproducing")
        data = write_report(plan, folder)
        return CommandResult({**data, "folder": folder}, lambda console: _print(console, data, folder))


def _cell(entry: Mapping[str, Any]) -> str:
    text = f"{entry['value']:.0f}"
    if entry["low"] == entry["low"]:  # one seed has no interval
        text += f" [{entry['low']:.0f}, {entry['high']:.0f}]"
    return text + (f" ({entry['published']:g})" if isinstance(entry["published"], (int, float)) else "")


def _dry_run(units: Sequence[Unit], work: Path, slots: int) -> CommandResult:
    """Count the units that are missing, and estimate how long they take."""
    from outlap.experiments.runner import missing_work

    counts, seconds = missing_work(units, work, slots)
    data = {"units": len(units), "missing": counts, "estimated_seconds": None if seconds is None else round(seconds)}
    about = "" if seconds is None else f"about {duration(seconds)}; "
    kinds = (f"{count:5} {kind}" for kind, count in counts.items())
    return CommandResult(data, lines(*kinds, f"{about}{len(units) - sum(counts.values())} of {len(units)} are done"))


def _print(console: Console, data: Mapping[str, Any], folder: Path) -> None:
    for name, methods in data["tables"].items():
        metrics = [metric for metric in SHOWN if metric in next(iter(methods.values()))]
        title = f"{name}; {data['record']['circuits'][name].title}"
        rows = [(method, *(_cell(row[metric]) for metric in metrics)) for method, row in methods.items()]
        console.print(table(("method", *(SHOWN[metric] for metric in metrics)), rows, left=("method",), title=title))
    console.print("mean over seeds [95 % interval], (the paper)", style="dim")
    console.print(f"report: {folder / 'report.html'}")
