"""Flags of commands that race a driver or show episodes, and what they print about recordings."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Count, CountOrZero, Flag, Positive
from outlap.cli.output import CommandResult, lines
from outlap.cli.progress import progress_bar
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.evaluation.recording import Recording
    from outlap.track import Track
    from outlap.training.subject import Subject

Episodes = Annotated[Positional[tuple[str, ...]], arg(metavar="EPISODE")]


@dataclass(frozen=True, kw_only=True)
class RaceFlags:
    """Flags of commands that race a driver."""

    task: str | None = None
    """A run folder: race as in its training, its cars with their ranges, on its held-out tracks; of a driver that has a
    scanner and a top speed of its own, those stay. By default the driver's own task."""

    v_max: Positive | None = None
    """[m/s] top speed of the cars, in place of the run's; what the policy commands stays within what it learnt."""

    num_cars: Count | None = None
    """The driver's car and opponents; by default as many as the run was trained with."""

    opponents: tuple[str, ...] = ()
    """Drivers and populations to draw opponents from, in place of the run's; one where the run had none."""

    opponent_code: Flag = False
    """Import modules for opponents, module:function, which runs their code; no run's configuration allows it."""

    opponent_split: Literal["train", "held_out"] = "held_out"
    """The half of a population that opponents are drawn from."""

    racing_line: Literal["track", "min-curvature", "min-time"] | None = None
    """That pure pursuit follows, in place of the run's: the track's own, or one planned for the car."""

    formation: Literal["queue", "behind", "grid", "scattered"] | None = None
    """In which the cars start, in place of the run's; behind: the driver's car is the last."""

    seed: CountOrZero = 0
    """Of the episodes."""

    def subject(self, name: str, *, deterministic: bool = True) -> Subject:
        """Return a driver, and what it is to race in. Raises what `find_subject` does."""
        from outlap.training.subject import subject_in_race

        flags = {field.name: getattr(self, field.name) for field in fields(RaceFlags)}
        return subject_in_race(name, deterministic=deterministic, **flags)


@dataclass(frozen=True, kw_only=True)
class EpisodeFlags(RaceFlags):
    """Flags of commands that show episodes: of drivers, raced now, or recorded before."""

    track: str | None = None
    """Name or map folder; by default that of the recordings, or the first held-out one of the run."""

    time_limit: Positive = 60.0
    """[s] of an episode that is raced now."""

    laps: CountOrZero = 0
    """Completed laps that end it; 0: none do."""

    def episodes(self, names: Sequence[str], quiet: bool) -> tuple[list[Recording], Track]:
        """Return the recordings of what is named, on one track. Raises what `find_episodes` does."""
        from outlap.evaluation.protocol import standing_starts
        from outlap.evaluation.recorder import record_episode
        from outlap.viewer.episodes import find_episodes, recording_files

        if not names:
            raise OutlapError(
                "no episode named; name recordings (.npz), folders of them, or drivers such as pure-pursuit"
            )
        given = [field.name for field in fields(RaceFlags) if getattr(self, field.name) != field.default]
        if given and all(recording_files(name) for name in names):
            flag = given[0].replace("_", "-")
            raise OutlapError(f"--{flag}: is for drivers that race now; what is named is recorded already")

        def race(subject: Subject, track: Track, seed: int) -> Recording:
            env = standing_starts(subject.env, [track], self.laps, self.time_limit)
            title = f"racing {subject.driver.name}"
            with progress_bar(title, math.ceil(self.time_limit), "seconds", quiet) as update:
                return record_episode(subject.driver, env, track, seed, on_progress=lambda now: update(int(now), ""))

        return find_episodes(names, self.track, self.seed, self.subject, race)


def with_recordings(result: CommandResult, folder: Path, track: Track) -> CommandResult:
    """Add to a command's result where its recordings are, and how to look at a track's first episode."""
    from outlap.evaluation.recording import RECORDINGS

    place = folder / RECORDINGS
    first = f"{shlex.quote(f'{place / track.name}-000')}*"

    def show(console: Console) -> None:
        result.show(console)
        console.print(f"look at it: outlap replay {first}")

    return CommandResult({**result.data, "recordings": place}, show)


def shown(recordings: list[Recording], path: Path, seconds: float | None = None) -> CommandResult:
    """Return the result of a command that has drawn recordings into a file."""
    races = [
        {"title": each.info.title, "outcome": each.info.outcome, "seconds": round(each.seconds, 2)}
        for each in recordings
    ]
    data = {"file": path, "bytes": path.stat().st_size, "races": races}
    if seconds is not None:
        data["seconds_to_draw"] = round(seconds, 1)

    took = "" if seconds is None else f", drawn in {seconds:.1f} s"
    ended = (f"{race['title']}: {race['outcome']} after {race['seconds']} s" for race in races)
    return CommandResult(data, lines(*ended, f"{path} ({path.stat().st_size / 1e6:.2f} MB{took})"))
