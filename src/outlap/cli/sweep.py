"""`outlap sweep` and `outlap tune`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from outlap.cli.output import CommandResult
from outlap.cli.progress import progress_bar
from outlap.cli.work import ClusterFlags, WorkFlags
from outlap.config import save_config

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console

    from outlap.training.session import TrainingConfig

File = Annotated[Positional[Path], arg(metavar="SWEEP.yaml")]
SHOWN = 20  # trials that are printed


@dataclass(frozen=True)
class Sweep(WorkFlags):
    """Search for hyper-parameters: train every trial to its end, and race its policies.

    The file says what is varied, see docs/training.md. Whatever is done is kept in --out: the same command goes on
    after a kill, and a changed file does anew only what is new in it.
    """

    file: File
    """What is varied."""

    out: Path | None = None
    """The folder for trials and results; by default runs/sweep-FILE."""

    quiet: FlagCreatePairsOff[bool] = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    def run(self) -> CommandResult:
        from outlap.config import load_config
        from outlap.experiments.sweep import SweepConfig, judge, plan_trials

        self.check_flags()
        trials = plan_trials(load_config(SweepConfig, self.file))
        folder = self.out or Path("runs") / f"sweep-{self.file.stem}"
        races = [race for trial in trials for race in trial.races]
        units = {unit.key: unit for race in races for unit in (*race.needs, race)}  # draws may come twice
        self.do_units(list(units.values()), folder / "work", "sweeping", self.quiet)
        found = judge(trials, folder / "work")
        best = trials[int(found["trial"].iloc[0])]
        return _result(found, best.config, folder, len(best.races))


@dataclass(frozen=True)
class Tune(ClusterFlags):
    """Search for hyper-parameters with Ray Tune: trials that fall behind are stopped early.

    It takes the file of `outlap sweep`, and judges trials by the progress of their training's last episodes. The same
    command goes on after a kill.
    """

    file: File
    """What is varied."""

    out: Path | None = None
    """The folder for trials and results; by default runs/tune-FILE."""

    quiet: FlagCreatePairsOff[bool] = False
    """Show no progress."""

    json: str | None = None
    """Write the result as JSON to this file; - for standard output."""

    def run(self) -> CommandResult:
        from outlap.config import load_config
        from outlap.experiments.sweep import SweepConfig
        from outlap.experiments.tune import tune_trials

        self.check_flags()
        sweep = load_config(SweepConfig, self.file)
        folder = self.out or Path("runs") / f"tune-{self.file.stem}"
        with progress_bar("tuning", len(sweep.draw()), "trials", self.quiet) as update:
            try:
                found = tune_trials(
                    sweep, folder, self.address, self.store, self.jobs, self.gpu_share,
                    lambda done, running: update(done, f"{running} running"),
                )  # fmt: skip
            except KeyboardInterrupt:
                print("\nsaved; go on with the same command", file=sys.stderr)
                raise
        best = sweep.trial_config(sweep.draw()[int(found["trial"].iloc[0])])
        return _result(found, best, folder)


def _result(found: pd.DataFrame, best: TrainingConfig, folder: Path, seeds: int = 0) -> CommandResult:
    """Trials as a file and a table, and the configuration of the best."""
    from outlap.evaluation.results import write_rows

    write_rows(found, folder / "trials.parquet")
    path = save_config(best, folder / "best.yaml")
    data = {"trials": found.to_dict("records"), "best": path, "folder": folder}

    def show(console: Console) -> None:
        from rich import box
        from rich.table import Table

        table = Table(box=box.SIMPLE_HEAD)
        shown = found.drop(columns=["progress_low_m", "progress_high_m"]) if seeds == 1 else found
        for name in shown.columns:
            table.add_column(str(name), justify="right", overflow="fold")
        for row in shown.head(SHOWN).itertuples(index=False):
            table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row))
        console.print(table)
        train = f"outlap train {best.algorithm} --config {path}"
        console.print(f"train with the best: {train}", highlight=False, markup=False, soft_wrap=True)

    return CommandResult(data, show)
