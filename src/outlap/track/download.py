"""Tracks from the official F1TENTH archive: verified, and in the cache either wholly or not at all."""

from __future__ import annotations

import datetime
import re
import sys
import urllib.parse
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, TypeAdapter

from outlap.config import Config
from outlap.errors import OutlapError, brief
from outlap.files import atomic_write
from outlap.track.archive import extract
from outlap.track.cache import cache_folder, install, staging
from outlap.track.catalog import OFFICIAL_TRACKS, is_track_folder, name_key
from outlap.track.map_io import read_track
from outlap.track.transfer import DownloadLimits, Progress, UnreachableError, fetch

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

ARCHIVE_URL = "https://api.f1tenth.org/{name}.tar.xz"
LOCK_FILE = "tracks.lock.json"
_OFFICIAL = ", ".join(OFFICIAL_TRACKS)


class LockedArchive(Config):
    """What an archive was when it was first downloaded; a later download must be the same bytes."""

    url: str
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    size_bytes: int
    date: str  # ISO 8601, UTC


_LOCK = TypeAdapter(dict[str, LockedArchive])


@dataclass(frozen=True)
class DownloadedTrack:
    """One track of a `download_tracks` call."""

    name: str
    path: Path
    status: Literal["downloaded", "present"]  # present: it was in the cache already, nothing was fetched
    archive: LockedArchive


def download_tracks(
    names: Iterable[str],
    *,
    cache: Path | None = None,
    url_template: str = ARCHIVE_URL,
    update_lock: bool = False,
    limits: DownloadLimits | None = None,
    show_progress: bool = False,
) -> list[DownloadedTrack]:
    """Put official tracks into the cache, where their names are found; a track that is there stays as it is.

    The archive publishes no checksums. The SHA-256 of the first download is kept in `tracks.lock.json` in the
    cache, and a later download of the same name must match it; copy that file to pin them on another machine.

    Args:
        names: official names, such as Spielberg; case, spaces and accents do not matter.
        cache: the folder of cached tracks; `cache_folder()` by default.
        url_template: https, with `{name}`.
        update_lock: fetch again what is there already, and accept an archive that has changed.
        limits: of sizes and time.
        show_progress: a bar on standard error if that is a terminal.

    Raises:
        OutlapError: one or more names failed; those that did not are in the cache all the same.
    """
    cache, limits = cache or cache_folder(), limits or DownloadLimits()
    official = dict.fromkeys(_official_name(name) for name in names)
    done: list[DownloadedTrack] = []
    failures: list[OutlapError] = []
    with _progress_bars(show_progress) as bars:
        for name in official:
            bar = bars.add_task(name, total=None)
            url = url_template.replace("{name}", urllib.parse.quote(name))

            def progress(size: int, total: int | None, bar: TaskID = bar) -> None:
                bars.update(bar, completed=size, total=total)

            try:
                done.append(_download(name, url, cache, limits, update_lock, progress))
            except UnreachableError:
                raise  # the others come from the same server
            except OSError as error:  # no space, for example: that ends them all
                raise OutlapError(f"{cache}: cannot be written ({error.strerror or error})") from error
            except OutlapError as error:
                hint = "" if name in OFFICIAL_TRACKS else f"; the official tracks are {_OFFICIAL}"
                failures.append(OutlapError(f"{error}{hint}"))
    if len(failures) == 1:
        raise failures[0]
    if failures:
        reasons = " | ".join(str(error) for error in failures)
        raise OutlapError(f"{len(failures)} of {len(failures) + len(done)} tracks failed: {reasons}")
    return done


def read_lock(cache: Path) -> dict[str, LockedArchive]:
    """Return the lock file of a cache, by track name; empty if there is none.

    Raises:
        OutlapError: it is not what `download_tracks` writes.
    """
    path = cache / LOCK_FILE
    try:
        return _LOCK.validate_json(path.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise OutlapError(f"{path}: not a lock file of outlap ({brief(error)}); mend it or delete it") from error


def _download(
    name: str, url: str, cache: Path, limits: DownloadLimits, update_lock: bool, progress: Progress
) -> DownloadedTrack:
    folder = cache / name
    with staging(cache) as prepared:
        locked = read_lock(cache)
        known = locked.get(name)
        if folder.exists():
            if known is None:
                raise OutlapError(f"{folder}: is there and was not downloaded; move it away to download {name}")
            if not update_lock:
                return DownloadedTrack(name, folder, "present", known)

        archive = prepared / "archive.tar.xz"
        sha256, size = fetch(url, archive, limits, progress)
        changed = known is None or known.sha256 != sha256
        if known and changed and not update_lock:
            raise OutlapError(
                f"{url}: sha256 is {sha256}, but {cache / LOCK_FILE} has {known.sha256} "
                f"of {known.date}; if the change is meant, run again with --update-lock"
            )
        content = prepared / "content"
        content.mkdir()
        extract(archive, content, limits.unpacked, called=url)
        track_folder = _only_track_folder(content, url)
        try:
            read_track(track_folder)
        except OutlapError as error:
            raise OutlapError(f"{url}: {str(error).replace(f'{content}/', '')}") from error

        # The digest before the track: after a kill between the two, the next download is still checked.
        if changed:
            now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
            locked[name] = LockedArchive(url=url, sha256=sha256, size_bytes=size, date=now)
            _write_lock(cache, locked)
        install(track_folder, folder)
    return DownloadedTrack(name, folder, "downloaded", locked[name])


def _official_name(name: str) -> str:
    """The archive's spelling of a name; one that is not on the list is taken as it is."""
    official = {name_key(each): each for each in OFFICIAL_TRACKS}.get(name_key(name))
    if official is not None:
        return official
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise OutlapError(f"{name!r} cannot be the name of a track in the archive; the official ones are {_OFFICIAL}")
    return name


def _only_track_folder(content: Path, url: str) -> Path:
    folders = [content, *sorted(path for path in content.rglob("*") if path.is_dir())]
    found = [folder for folder in folders if is_track_folder(folder)]
    if len(found) != 1:
        raise OutlapError(
            f"{url}: holds {len(found)} folders with a map (NAME_map.yaml or NAME.yaml); there must be one"
        )
    return found[0]


def _write_lock(cache: Path, locked: dict[str, LockedArchive]) -> None:
    atomic_write(cache / LOCK_FILE, _LOCK.dump_json(dict(sorted(locked.items())), indent=2) + b"\n")


def _progress_bars(shown: bool) -> RichProgress:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, TransferSpeedColumn
    from rich.progress import Progress as RichProgress

    columns = ("{task.description}", BarColumn(), DownloadColumn(), TransferSpeedColumn())
    hidden = not (shown and sys.stderr.isatty())
    return RichProgress(*columns, console=Console(stderr=True), transient=True, disable=hidden)
