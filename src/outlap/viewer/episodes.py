"""Episodes to show: recorded before, or raced now."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from outlap.errors import OutlapError
from outlap.evaluation.protocol import episode_seeds
from outlap.evaluation.recording import RECORDINGS, SUFFIX, Recording
from outlap.track import Track, load_track
from outlap.training.run import Run, is_run
from outlap.training.subject import Subject, held_out_tracks


def recording_files(name: str) -> list[Path]:
    """Return the recordings that a name stands for: itself, or those in a folder; none for a driver.

    Raises OutlapError for a folder without any that is no run either.
    """
    path = Path(name)
    if path.suffix == SUFFIX:
        return [path]
    if not path.is_dir() or is_run(name):
        return []
    files = sorted(path.glob(f"*{SUFFIX}")) or sorted((path / RECORDINGS).glob(f"*{SUFFIX}"))
    if not files:
        raise OutlapError(f"{name}: holds no recording; make some with outlap evaluate --record 3")
    return files


def load_recordings(names: Sequence[str]) -> list[Recording]:
    """Return the recordings in files and folders. Raise OutlapError for a name that stands for none."""
    found = []
    for name in names:
        files = recording_files(name)
        if not files:
            raise OutlapError(f"{name}: is no recording; make some with outlap evaluate --record 3")
        found += [Recording.load(file) for file in files]
    if not found:
        raise OutlapError("no recording named; make some with outlap evaluate --record 3")
    return found


def find_episodes(
    names: Sequence[str],
    track: str | None,
    seed: int,
    find_subject: Callable[[str], Subject],
    race: Callable[[Subject, Track, int], Recording],
) -> tuple[list[Recording], Track]:
    """Return the episodes that names stand for, on one track, and that track.

    Args:
        names: of recordings, of folders of them, or of drivers, which race the episode of the first recording.
        track: name or map folder; if None, that of the recordings, or the first held-out one of a driver's task.
        seed: of the episode to race if there is no recording.
        find_subject: returns the driver that a name stands for.
        race: returns the recording of a driver on a track, given the seed of the episode.

    Raises OutlapError for names of nothing, and for recordings of several tracks.
    """
    loaded = {name: [Recording.load(path) for path in recording_files(name)] for name in names}
    drivers = {name: find_subject(name) for name, recordings in loaded.items() if not recordings}
    recorded = [recording for recordings in loaded.values() for recording in recordings]
    on = load_track(track or _track_name(recorded, [subject.task for subject in drivers.values()]))
    chosen = {name: _raced_on(on, name, recordings) for name, recordings in loaded.items()}
    seeds = [recording.info.seed for recordings in chosen.values() for recording in recordings]
    first = seeds[0] if seeds else int(episode_seeds(seed, on.name, 1)[0])
    found = [recording for name in chosen for recording in chosen[name] or [race(drivers[name], on, first)]]
    return _with_distinct_titles(found), on


def _track_name(recorded: Sequence[Recording], tasks: Sequence[Run | None]) -> str:
    """Return the one track of recordings; without any, the first one that drivers are not trained on."""
    names = sorted({recording.info.track for recording in recorded})
    if names and Path(names[0]).name != names[0]:
        raise OutlapError(f"recordings of {names[0]}: give its map folder as --track")
    if len(names) > 1:
        raise OutlapError(f"recordings of several tracks: {', '.join(names)}; say which one with --track")
    return names[0] if names else held_out_tracks(tasks[0])[0]


def _raced_on(track: Track, name: str, recordings: Sequence[Recording]) -> list[Recording]:
    found = [each for each in recordings if each.info.track_fingerprint == track.fingerprint]
    if recordings and not found:
        raise OutlapError(
            f"{name}: was raced on {recordings[0].info.track}, and {track.name} is another track, or another version "
            "of it; give the map folder as --track, and show races on one track together"
        )
    return found


def _with_distinct_titles(recordings: Sequence[Recording]) -> list[Recording]:
    titles = [recording.info.title for recording in recordings]

    def numbered(number: int) -> Recording:
        title = f"{titles[number]} #{titles[: number + 1].count(titles[number])}"
        return replace(recordings[number], info=recordings[number].info.model_copy(update={"title": title}))

    return [
        recording if titles.count(recording.info.title) == 1 else numbered(number)
        for number, recording in enumerate(recordings)
    ]
