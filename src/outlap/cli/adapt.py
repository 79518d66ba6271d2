"""`outlap adapt`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, CountOrZero, Positive
from outlap.cli.output import CommandResult, dated_folder, table
from outlap.cli.races import with_recordings
from outlap.cli.work import WorkCommand

if TYPE_CHECKING:
    from rich.console import Console

Rule = Literal["abc", "fixed", "none"]


@dataclass(frozen=True)
class Adapt(WorkCommand):
    """Adapt a meta-trained policy to tracks, and race it before and after on the same episodes.

    A task is a track with the run's cars, drawn anew in every episode. Every clip rule adapts from the same
    seeds, each time starting from the meta-policy, which stays as it is. After a kill or Ctrl-C, the same command with
    the same --out resumes.
    """

    run_folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run folder of `outlap train mql`."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; by default the run's held-out tracks, or else the built-in held-out ones."""

    clip: tuple[Rule, ...] = ("none", "fixed", "abc")
    """How propensity weights are clipped: Adaptive Beta Clipping, the original's fixed clip, or not."""

    seeds: Count = 5
    """Adaptations to each track with each clip rule."""

    iterations: Count = 10
    """Of each adaptation."""

    collect_steps: Count = 100
    """Actions in the new task that each of --collect-worlds makes before every iteration."""

    collect_worlds: Count = 8
    """Cars that collect."""

    on_task_steps: int = 5
    """Updates on the new task alone in every iteration."""

    replay_steps: int = 30
    """Updates on the weighted replay in every iteration."""

    learning_rate: float = 1e-4
    """Of the adaptation."""

    episodes: Count = 100
    """Raced on each track before, and after each adaptation."""

    time_limit: Positive = 40.0
    """[s] of an episode."""

    seed: int = 0
    """Of the episodes, and the first of the adaptations."""

    record: CountOrZero = 0
    """Of each track's episodes, keep so many, raced before and after the first adaptation with each clip rule, to be
    looked at with `outlap replay`, `outlap video` or `outlap plot`."""

    out: Path | None = None
    """A new folder for the results, or one in which the same adaptations were begun; by default RUN/adaptations/TIME.
    """

    def run(self) -> CommandResult:
        from outlap.experiments.adaptation import Races, adaptation_units, prepare_adaptations, write_adaptations
        from outlap.track.catalog import load_tracks
        from outlap.training.run import load_run
        from outlap.training.subject import held_out_tracks

        self.check_flags()
        run = load_run(self.run_folder)
        names = self.tracks or held_out_tracks(run)
        tracks = load_tracks(names)
        constants = ("iterations", "collect_steps", "on_task_steps", "replay_steps", "learning_rate")
        races = Races(self.episodes, self.time_limit, self.seed, min(self.record, self.episodes))
        seeds = range(self.seed, self.seed + self.seeds)
        settings = {name: getattr(self, name) for name in constants}
        units = adaptation_units(run, names, self.clip, seeds, settings, self.collect_worlds, races)
        folder = self.out or dated_folder(run.folder / "adaptations")
        prepare_adaptations(folder)
        self.do_units(units, folder / "work", "adapting", resume=f"go on with: {self._command(folder)}")
        fingerprints = {track.name: track.fingerprint for track in tracks}
        data = {**write_adaptations(units, folder, self, fingerprints), "folder": folder}
        result = CommandResult(data, lambda console: _print(console, data))
        return with_recordings(result, folder, tracks[0]) if self.record else result

    def _command(self, folder: Path) -> str:
        """Return the command that resumes in a folder."""
        words = ["outlap", "adapt", str(self.run_folder)]
        for each in fields(self):
            value = getattr(self, each.name)
            if each.name not in ("run_folder", "out", "json", "quiet") and value != each.default:
                values = value if isinstance(value, tuple) else (value,)
                words += [f"--{each.name.replace('_', '-')}", *map(str, values)]
        return shlex.join([*words, "--out", str(folder)])


def _print(console: Console, data: Mapping[str, Any]) -> None:
    rows: list[tuple[str, ...] | None] = []
    for method, summary in data.items():
        if method != "folder":
            for track, each in [*summary["tracks"].items(), ("all", summary["all"])]:
                cells = (_cell(each[key], scale, digits) for key, scale, digits in COLUMNS.values())
                rows.append((method, track, *cells))
            rows.append(None)
    left = ("method", "track")
    console.print(table((*left, *COLUMNS), rows, left, "before and after adapting"))
    console.print("mean over adaptation seeds [95 % interval]", style="dim")
    console.print(f"results: {data['folder']}")


COLUMNS = {  # heading: key, scale, digits
    "crash rate [%]": ("crash_rate", 100.0, 1),
    "speed [m/s]": ("mean_speed_mps", 1.0, 2),
    "lap / least": ("lap_time_ratio", 1.0, 3),
    "progress [m]": ("progress_m", 1.0, 0),
}


def _cell(value: Mapping[str, float], scale: float, digits: int) -> str:
    if value["mean"] is None:  # nobody came so far
        return "-"
    mean = f"{scale * value['mean']:.{digits}f}"
    if value["low"] is None:  # one seed has no interval
        return mean
    return f"{mean} [{scale * value['low']:.{digits}f}, {scale * value['high']:.{digits}f}]"
