"""Episodes to look at: recordings, and drivers that race one now."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from outlap.cli.arguments import check_least
from outlap.cli.output import CommandResult
from outlap.cli.progress import progress_bar
from outlap.cli.races import RaceFlags, check_positive
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.evaluation.recording import Recording
    from outlap.track import Track
    from outlap.training.run import Run

Episodes = Annotated[Positional[tuple[str, ...]], arg(metavar="EPISODE")]


def with_recordings(result: CommandResult, folder: Path, track: Track) -> CommandResult:
    """A command's result that says where its recordings are, and how to look at a track's first episode."""
    from outlap.evaluation.recording import RECORDINGS

    place = folder / RECORDINGS
    first = f"{shlex.quote(f'{place / track.name}-000')}*"

    def show(console: Console) -> None:
        result.show(console)
        console.print(f"look at it: outlap replay {first}")

    return CommandResult({**result.data, "recordings": place}, show)


@dataclass(frozen=True, kw_only=True)
class EpisodeFlags(RaceFlags):
    """Flags of commands that show episodes: of drivers, raced now, or recorded before."""

    track: str | None = None
    """Name or map folder; by default that of the recordings, or the first held-out one of the run."""

    time_limit: float = 60.0
    """[s] of an episode that is raced now."""

    laps: int = 0
    """Completed laps that end it; 0: none do."""

    def episodes(self, names: Sequence[str], quiet: bool) -> tuple[list[Recording], Track]:
        """Recordings of what is named, on one track.

        Raises OutlapError for names of nothing, and for recordings of several tracks.
        """
        from outlap.evaluation.protocol import episode_seeds, standing_starts
        from outlap.evaluation.recorder import record_episode
        from outlap.evaluation.recording import Recording
        from outlap.track import load_track

        self.check_races()
        check_positive("--time-limit", self.time_limit)
        check_least("--laps", self.laps, 0)
        if not names:
            raise OutlapError(
                "no episode named; name recordings (.npz), folders of them, or drivers such as pure-pursuit"
            )
        loaded = {name: {path: Recording.load(path) for path in recording_files(name)} for name in names}
        drivers = {name: self.subject(name) for name, files in loaded.items() if not files}
        if not drivers:
            self._check_unused()
        recorded = [recording for files in loaded.values() for recording in files.values()]
        track = load_track(self.track or _track_name(recorded, [found.task for found in drivers.values()]))
        chosen = {name: _raced_on(track, name, files) for name, files in loaded.items()}
        # Drivers race the episode of the first recording, if there is one.
        seeds = [recording.info.seed for files in chosen.values() for recording in files]
        seed = seeds[0] if seeds else int(episode_seeds(self.seed, track.name, 1)[0])
        found: list[Recording] = []
        for name, recordings in chosen.items():
            found += recordings
            if not recordings:
                subject = drivers[name]
                env = standing_starts(subject.env, [track], self.laps, self.time_limit)
                whole = math.ceil(self.time_limit)
                with progress_bar(f"racing {subject.driver.name}", whole, "seconds", quiet) as update:
                    found.append(
                        record_episode(
                            subject.driver, env, track, seed, on_progress=lambda now, show=update: show(int(now), "")
                        )
                    )
        return told_apart(found), track

    def _check_unused(self) -> None:
        """Raises OutlapError for a flag of races where nobody races now."""
        for flag in fields(RaceFlags):
            if getattr(self, flag.name) != flag.default:
                name = flag.name.replace("_", "-")
                raise OutlapError(f"--{name}: is for drivers that race now; what is named is recorded already")


def _track_name(recorded: Sequence[Recording], tasks: Sequence[Run | None]) -> str:
    """The one track of recordings; without any, the first one that drivers are not trained on."""
    names = sorted({recording.info.track for recording in recorded})
    if names and Path(names[0]).name != names[0]:
        raise OutlapError(f"recordings of {names[0]}: give its map folder as --track")
    if len(names) > 1:
        raise OutlapError(f"recordings of several tracks: {', '.join(names)}; say which one with --track")
    if names:
        return names[0]
    from outlap.training.subject import held_out_tracks

    return held_out_tracks(tasks[0])[0]


def _raced_on(track: Track, name: str, recordings: Mapping[Path, Recording]) -> list[Recording]:
    """Those that were raced on a track."""
    found = [each for each in recordings.values() if each.info.track_fingerprint == track.fingerprint]
    if recordings and not found:
        other = next(iter(recordings.values())).info.track
        raise OutlapError(
            f"{name}: was raced on {other}, and {track.name} is another track, or another version of it; "
            "give the map folder as --track, and show races on one track together"
        )
    return found


def recording_files(name: str) -> list[Path]:
    """The recordings that a name stands for: itself, or those in a folder; none for a driver.

    Raises OutlapError for a folder without any that is no run either.
    """
    from outlap.evaluation.recording import RECORDINGS, SUFFIX
    from outlap.training.run import is_run

    path = Path(name)
    if path.suffix == SUFFIX:
        return [path]
    if not path.is_dir() or is_run(name):
        return []
    files = sorted(path.glob(f"*{SUFFIX}")) or sorted((path / RECORDINGS).glob(f"*{SUFFIX}"))
    if not files:
        raise OutlapError(f"{name}: holds no recording; make some with outlap evaluate --record 3")
    return files


def told_apart(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings with titles that differ."""
    titles = [recording.info.title for recording in recordings]
    return [
        recording
        if titles.count(title) == 1
        else replace(
            recording, info=recording.info.model_copy(update={"title": f"{title} #{titles[: number + 1].count(title)}"})
        )
        for number, (recording, title) in enumerate(zip(recordings, titles, strict=True))
    ]


def shown(recordings: list[Recording], path: Path, seconds: float | None = None) -> CommandResult:
    """The result of a command that has drawn recordings into a file."""
    data = {
        "file": path,
        "bytes": path.stat().st_size,
        "races": [
            {"title": each.info.title, "outcome": each.info.outcome, "seconds": round(each.seconds, 2)}
            for each in recordings
        ],
        **({} if seconds is None else {"seconds_to_draw": round(seconds, 1)}),
    }

    def show(console: Console) -> None:
        for race in data["races"]:
            console.print(f"{race['title']}: {race['outcome']} after {race['seconds']} s")
        took = "" if seconds is None else f", drawn in {seconds:.1f} s"
        console.print(f"{path} ({data['bytes'] / 1e6:.2f} MB{took})")

    return CommandResult(data, show)
