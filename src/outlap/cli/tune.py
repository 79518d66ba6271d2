"""`outlap tune`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.output import CommandResult, table
from outlap.cli.work import WorkCommand

if TYPE_CHECKING:
    from rich.console import Console

SHOWN = 20  # trials that are printed


@dataclass(frozen=True)
class Tune(WorkCommand):
    """Search for hyper-parameters: train trials, race their policies, and stop those that fall behind.

    The file says what is varied, see docs/clusters.md. Finished work is kept in --out: the same command resumes after
    a kill, and a changed file trains only what is new in it.
    """

    file: Annotated[Positional[Path], arg(metavar="SEARCH.yaml")]
    """What is varied."""

    out: Path | None = None
    """The folder for trials and results; by default runs/tune-FILE."""

    def run(self) -> CommandResult:
        from outlap.config import load_config, save_config
        from outlap.evaluation.results import write_rows
        from outlap.experiments.search import SearchConfig
        from outlap.experiments.tune import Tuner

        self.check_flags()
        folder = self.out or Path("runs") / f"tune-{self.file.stem}"
        config = load_config(SearchConfig, self.file)
        parallel = self.count_slots() if config.sampler == "tpe" else 1  # which alone depends on it
        tuner = Tuner(config, folder, parallel)
        self.do_units(tuner.first_units(), tuner.work, "tuning", tuner.on_done, tuner.on_failed, config.tracks)
        found = tuner.results()
        write_rows(found, folder / "trials.parquet")
        best = tuner.trials[int(found["trial"].iloc[0])].rungs[-1][0]
        path = save_config(best.config, folder / "best.yaml")
        run = best.folder(tuner.work)
        data = {"trials": found.to_dict("records"), "best": path, "best_run": run, "folder": folder}

        def show(console: Console) -> None:
            shown = found.drop(columns=["progress_low_m", "progress_high_m"]) if config.seeds == 1 else found
            rows = [
                [f"{value:.4g}" if isinstance(value, float) else value for value in row]
                for row in shown.head(SHOWN).itertuples(index=False)
            ]
            console.print(table([str(name) for name in shown.columns], rows))
            console.print(f"the best run: {run}")
            console.print(f"train with the best: outlap train {best.config.algorithm} --config {path}")

        return CommandResult(data, show)
