"""`outlap compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, CountOrZero, LongCommand, Positive
from outlap.cli.output import CommandResult, dated_folder, lines
from outlap.errors import OutlapError


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

    episodes: Count = 100
    """On each track."""

    time_limit: Positive = 40.0
    """[s] of an episode."""

    seed: CountOrZero = 0
    """Of the episodes."""

    out: Path | None = None
    """A new or empty folder for the report; by default runs/compare-TIME."""

    def run(self) -> CommandResult:
        from outlap.evaluation.protocol import standing_starts
        from outlap.evaluation.results import prepare_folder
        from outlap.experiments.comparison import Subject, group, race_subjects, write_comparison
        from outlap.provenance import provenance
        from outlap.track.catalog import load_tracks
        from outlap.training.subject import find_subject, held_out_tracks

        if len(self.runs) < 2:
            raise OutlapError("one run alone; name two or more, or use outlap evaluate")
        found = [(name, *find_subject(name)) for name in self.runs]
        subjects = [Subject(driver.name if run else name, driver, run) for name, driver, _, run in found]
        _, task, run = find_subject(self.task) if self.task else found[0][1:]
        tracks = load_tracks(self.tracks or held_out_tracks(run))
        races = standing_starts(task.model_copy(update={"opponent_split": "held_out"}), tracks, 0, self.time_limit)
        folder = self.out or dated_folder(Path("runs"), "compare-")
        prepare_folder(folder)
        groups = group(subjects)
        total = len(subjects) * len(tracks) * self.episodes
        with self.progress("racing", total, "episodes") as update:
            rows = race_subjects(groups, races, tracks, self.episodes, self.seed, update)
        record = {**provenance(), "settings": self, "env": races}
        lengths = {track.name: track.centerline.length for track in tracks}
        data = write_comparison(folder, rows, groups, races.num_cars == 1, lengths, record)
        show = lines((folder / "report.md").read_text(), f"report: {folder / 'report.html'}")
        return CommandResult({**data, "folder": folder}, show)
