"""`outlap compare`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.command import LongCommand
from outlap.cli.output import CommandResult
from outlap.cli.races import unused
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Compare(LongCommand):
    """Race runs on the same episodes and say what the differences show, with their intervals.

    All are compared with the first. Runs that differ in nothing but their seed are trainings of one method; with two
    or more of each, intervals are over seeds.
    """

    runs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN")]
    """Run folders of `outlap train`, or drivers without one, such as follow-the-gap."""

    task: str | None = None
    """A run folder in whose task all are raced: cars with their ranges, opponents, tracks; by default the first run. Of
    a driver that has a scanner and a top speed of its own, those stay."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the task's held-out tracks, or else the built-in held-out ones."""

    episodes: int = 100
    """On each track."""

    time_limit: float = 40.0
    """[s] of an episode."""

    seed: int = 0
    """Of the episodes."""

    out: Path | None = None
    """A new or empty folder for the report; by default runs/compare-TIME."""

    def run(self) -> CommandResult:
        import pandas as pd

        from outlap.evaluation.protocol import made_for, standing_starts
        from outlap.evaluation.results import prepare_folder
        from outlap.evaluation.rollout import evaluate
        from outlap.experiments.comparison import Subject, group, write_comparison
        from outlap.provenance import provenance
        from outlap.track.catalog import load_tracks
        from outlap.training.subject import find_subject, held_out_tracks

        check_least("--episodes", self.episodes, 1)
        check_least("--seed", self.seed, 0)
        if not 0.0 < self.time_limit < float("inf"):
            raise OutlapError(f"--time-limit is {self.time_limit}; must be > 0")
        if len(self.runs) < 2:
            raise OutlapError("one run alone; name two or more, or use outlap evaluate")
        found = [(name, *find_subject(name)) for name in self.runs]
        subjects = [Subject(driver.name if run else name, driver, run) for name, driver, _, run in found]
        _, task, run = find_subject(self.task) if self.task else found[0][1:]
        tracks = load_tracks(self.tracks or held_out_tracks(run))
        races = standing_starts(task.model_copy(update={"opponent_split": "held_out"}), tracks, 0, self.time_limit)
        folder = self.out or unused(Path("runs") / time.strftime("compare-%Y%m%d-%H%M%S"))
        prepare_folder(folder)
        groups = group(subjects)
        rows = []
        total = len(subjects) * len(tracks) * self.episodes
        with self.progress("racing", total, "episodes") as update:
            for method, members in groups.items():
                for subject in members:
                    before = len(rows) * len(tracks) * self.episodes
                    env = made_for(subject.driver, races)
                    raced = evaluate(
                        subject.driver, env, tracks, self.episodes, self.seed, lap_time_ratios=False,
                        on_progress=lambda now, before=before, name=subject.name: update(before + int(now.done), name),
                    )  # fmt: skip
                    rows.append(raced.assign(method=method, training_seed=subject.seed, task=raced["track"]))
        record = {**provenance(), "settings": self, "env": races}
        everything = pd.concat(rows, ignore_index=True)
        data = write_comparison(folder, everything, groups, races.num_cars == 1, record)
        return CommandResult({**data, "folder": folder}, lambda console: _print(console, data, folder))


def _print(console: Console, data: Mapping[str, Any], folder: Path) -> None:
    console.print((folder / "report.md").read_text())
    console.print(f"report: {folder / 'report.html'}")
