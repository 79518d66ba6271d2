"""`outlap tracks list | show | generate | import | download`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic.dataclasses import dataclass
from tyro.conf import Positional, arg

from outlap.cli.command import Command, Flag
from outlap.cli.output import CommandResult, lines, table
from outlap.errors import OutlapError
from outlap.files import make_folder

if TYPE_CHECKING:
    from rich.console import Console

    from outlap.track import Track


@dataclass(frozen=True)
class ListTracks(Command):
    """List every track that can be used by its name.

    They come from the folders of OUTLAP_TRACKS, the cache (downloaded or imported), and the built-in set.
    """

    def run(self) -> CommandResult:
        from outlap.track.catalog import list_tracks

        rows = [entry.summary() for entry in list_tracks()]
        return CommandResult({"tracks": rows}, lambda console: _print_list(console, rows))


@dataclass(frozen=True)
class ShowTrack(Command):
    """Draw a track: its map, its centreline and the curvature along it."""

    track: Positional[str]
    """Name, map folder or centreline csv."""

    out: Path | None = None
    """The picture; NAME.png here by default. An older one is replaced."""

    def run(self) -> CommandResult:
        from outlap.track import load_track

        track = load_track(self.track)
        out = self.out or Path(f"{track.name}.png")
        if out.is_dir() or out.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise OutlapError(f"--out is {out}; must be a file that ends in .png, .pdf or .svg")
        from outlap.viewer.plots import draw_track  # Matplotlib: not before it is needed

        draw_track(track, make_folder(out.parent) / out.name)
        data = track.summary() | {"picture": out}
        return CommandResult(data, lines(_summary(data), f"picture: {out}"))


@dataclass(frozen=True)
class GenerateTrack(Command):
    """Make a random closed circuit and write it as an F1TENTH map folder; a seed always gives the same."""

    seed: int
    """Whole number, 0 or more."""

    out: Path | None = None
    """The map folder to make; ./NAME by default. It must be empty or absent."""

    length: float = 300.0
    """[m] of the centreline."""

    width: float = 2.2
    """[m] from wall to wall."""

    min_radius: float = 1.5
    """[m] of the tightest corner of the centreline, at least half the width."""

    clockwise: Flag = False
    """Drive it clockwise; by default the seed decides."""

    anticlockwise: Flag = False
    """Drive it anticlockwise; by default the seed decides."""

    name: str | None = None
    """The track's name; by default that of the folder, or generated-SEED."""

    def run(self) -> CommandResult:
        from outlap.track import write_track
        from outlap.track.generate import generate_track

        if self.clockwise and self.anticlockwise:
            raise OutlapError("--clockwise and --anticlockwise exclude each other; give one, or neither")
        folder_name = None if self.out is None else self.out.absolute().name
        name = self.name or folder_name or f"generated-{self.seed}"
        out = self.out or Path(name)
        _require_empty(out)
        clockwise = self.clockwise if self.clockwise or self.anticlockwise else None
        track = generate_track(
            self.seed, length=self.length, width=self.width, min_radius=self.min_radius, name=name, clockwise=clockwise
        )
        return _written(track, write_track(track, out), "folder")


@dataclass(frozen=True)
class ImportTrack(Command):
    """Check an F1TENTH map folder or a TUM centreline csv and store it, so that its name finds it."""

    source: Positional[Path]
    """A map folder, or a csv with x_m, y_m, w_tr_right_m, w_tr_left_m."""

    name: str | None = None
    """The track's name; by default that of its files."""

    scale: float | None = None
    """Of a csv: factor on positions and widths; 0.1 by default, from full scale to 1:10."""

    half_width: float | None = None
    """[m] of a csv: from the centreline to either wall after scaling; by default the file's own widths."""

    out: Path | None = None
    """Write a map folder here and leave the cache as it is."""

    force: Flag = False
    """Replace a track that is there already."""

    def run(self) -> CommandResult:
        from outlap.track import write_track
        from outlap.track.cache import cache_folder, install, staging

        track = self._read()
        if self.name is not None:
            track = replace(track, name=self.name)
        if self.out is not None:
            if not self.force:
                _require_empty(self.out)
            return _written(track, write_track(track, self.out), "folder")
        with staging(cache_folder()) as prepared:
            folder = write_track(track, prepared / "track")  # refuses a name that cannot be a folder's
            target = cache_folder() / track.name
            if target.exists() and not self.force:
                raise OutlapError(f"{target}: this name is taken; give another --name, or --force to replace the track")
            install(folder, target)
        return _written(track, target, "cache")

    def _read(self) -> Track:
        from outlap.track.map_io import read_track, read_tum_centerline

        if self.source.is_dir():
            if self.scale is not None or self.half_width is not None:
                raise OutlapError(f"--scale and --half-width are for a csv; {self.source} is a map folder")
            return read_track(self.source)
        if not self.source.is_file():
            raise OutlapError(f"{self.source}: does not exist; must be a map folder or a centreline csv")
        scale = 0.1 if self.scale is None else self.scale
        return read_tum_centerline(self.source, scale=scale, half_width=self.half_width)


@dataclass(frozen=True)
class DownloadTracks(Command):
    """Get circuits from the official F1TENTH archive into the cache, so that their names find them.

    The SHA-256 of each is kept in tracks.lock.json in the cache; a later download must be the same bytes.
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME...")] = ()
    """Such as Spielberg Monza."""

    all: Flag = False
    """All official tracks."""

    update_lock: Flag = False
    """Fetch again what is there already, and accept an archive that has changed."""

    url: str = "https://api.f1tenth.org/{name}.tar.xz"
    """Of a mirror, with {name}; https only."""

    def run(self) -> CommandResult:
        from outlap.track.catalog import OFFICIAL_TRACKS
        from outlap.track.download import download_tracks

        if self.all == bool(self.names):
            official = ", ".join(OFFICIAL_TRACKS)
            raise OutlapError(f"give the names of tracks, or --all; the official ones are {official}")
        if "{name}" not in self.url:
            raise OutlapError(f"--url is {self.url}; must hold {{name}} where the track's name goes")
        names = OFFICIAL_TRACKS if self.all else self.names
        tracks = download_tracks(names, url_template=self.url, update_lock=self.update_lock, show_progress=True)
        rows = [
            {"name": track.name, "status": track.status, "path": track.path}
            | track.archive.model_dump(exclude={"date"})
            for track in tracks
        ]
        show = lines(*(f"{track.name} {track.status}: {track.path}" for track in tracks))
        return CommandResult({"tracks": rows}, show)


def _require_empty(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise OutlapError(f"--out {folder}: is there already; must be an empty or a new folder")


def _written(track: Track, folder: Path, kind: str) -> CommandResult:
    data = track.summary() | {"path": folder}
    usable_as = folder
    notes = []
    if kind == "cache":
        from outlap.track.catalog import find_entry

        usable_as = track.name
        found = find_entry(track.name)
        if found.path != folder:
            notes.append(f"note: {found.path} has this name too and is found first; give another --name")

    written = (f"written to: {folder}", f"to see it: outlap tracks show '{usable_as}'")
    return CommandResult(data, lines(_summary(data), *written, *notes))


def _print_list(console: Console, rows: list[dict[str, Any]]) -> None:
    from rich.text import Text

    cells = [
        (
            row["name"],
            row["source"] + (f" ({row['split'].replace('_', '-')})" if "split" in row else ""),
            "" if row["length_m"] is None else f"{row['length_m']:.1f}",
            Text(row["error"], style="red") if "error" in row else row["path"] or "",
        )
        for row in rows
    ]
    console.print(table(("track", "source", "length [m]", "path"), cells, left=("track", "source", "path")))


def _summary(data: dict[str, Any]) -> str:
    way = "clockwise" if data["clockwise"] else "anticlockwise"
    return (
        f"{data['name']}: {data['length_m']:.1f} m {way}, tightest radius {data['min_radius_m']:.2f} m, "
        f"width {data['mean_width_m']:.2f} m (least {data['min_width_m']:.2f} m)"
    )
