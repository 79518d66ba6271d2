"""Finding a track by name: the folders of OUTLAP_TRACKS, then the user's cache, then the built-in set."""

from __future__ import annotations

import difflib
import os
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from outlap.errors import OutlapError
from outlap.track import map_io
from outlap.track.cache import cache_folder
from outlap.track.generate import (
    BUILTIN_HELD_OUT,
    BUILTIN_TRAIN,
    HELD_OUT_CIRCUITS,
    TRAINING_CIRCUITS,
    builtin_track,
)
from outlap.track.track import Track

TRACKS_VARIABLE = "OUTLAP_TRACKS"

# What the official archive holds: the circuits of the F1TENTH racetrack collection.
OFFICIAL_TRACKS = (
    "Austin", "BrandsHatch", "Budapest", "Catalunya", "Hockenheim", "IMS", "Melbourne", "MexicoCity",
    "Montreal", "Monza", "MoscowRaceway", "Norisring", "Nuerburgring", "Oschersleben", "Sakhir", "SaoPaulo",
    "Sepang", "Shanghai", "Silverstone", "Sochi", "Spa", "Spielberg", "YasMarina", "Zandvoort",
)  # fmt: skip


@dataclass(frozen=True)
class TrackEntry:
    """A track that can be loaded by its name."""

    name: str
    source: Literal["folder", "cache", "builtin"]  # a folder of OUTLAP_TRACKS, the user's cache, generated
    path: Path | None = None  # its map folder; None for a built-in one
    split: Literal["train", "held_out"] | None = None  # of the built-in set

    def load(self) -> Track:
        """Return the track, with this name; raise OutlapError if its files are not valid."""
        if self.path is None:
            return builtin_track(self.name)
        track = map_io.read_track(self.path)
        return track if track.name == self.name else replace(track, name=self.name)

    def length(self) -> float:
        """Return the length of the centreline [m] without reading the map; raise OutlapError if the csv is bad."""
        if self.path is None:
            return (TRAINING_CIRCUITS | HELD_OUT_CIRCUITS)[self.name].length
        return map_io.read_centerline_csv(map_io.find_centerline_csv(self.path, self.name)).length

    def summary(self) -> dict[str, Any]:
        """Return name, source, split if it has one, length [m], path, and the error of a track that cannot be read."""
        split = {} if self.split is None else {"split": self.split}
        row: dict[str, Any] = {"name": self.name, "source": self.source, **split, "length_m": None, "path": self.path}
        try:
            return row | {"length_m": round(self.length(), 3)}
        except (OutlapError, OSError) as error:
            return row | {"error": str(error)}


def load_track(path_or_name: str | os.PathLike[str]) -> Track:
    """Load an F1TENTH map folder, a TUM centreline csv, or a track by name.

    A folder or file that exists wins over a name.

    Raises:
        OutlapError: nothing is found, or what is found is not a valid track.
    """
    path = Path(path_or_name).expanduser()
    text = os.fspath(path_or_name)
    is_bare_name = isinstance(path_or_name, str) and not {"/", os.sep} & set(text) and text not in (".", "..")
    if path.is_file() and path.suffix.lower() == ".csv":
        return map_io.read_tum_centerline(path)
    # A folder that merely shares a track's name is not that track.
    if path.is_dir() and not (is_bare_name and not map_io.find_yaml_files(path)):
        return map_io.read_track(path)
    if is_bare_name and not path.is_file():
        return find_track(text)
    what = "is neither a map folder nor a centreline .csv" if path.is_file() else "does not exist"
    raise OutlapError(f"{path}: {what}; give a map folder, a centreline .csv or a track's name")


def load_tracks(tracks: Sequence[str | os.PathLike[str] | Track], augment: bool = False) -> tuple[Track, ...]:
    """Load tracks by name or path; one that is loaded already is returned as it is.

    Args:
        tracks: names, paths or tracks.
        augment: add each one driven the other way round, mirrored, and both.
    """
    loaded = tuple(each if isinstance(each, Track) else load_track(each) for each in tracks)
    if not augment:
        return loaded
    both_ways = [way for track in loaded for way in (track, track.reversed())]
    return tuple(seen for track in both_ways for seen in (track, track.mirrored()))


def search_path() -> list[Path]:
    """The folders of map folders, in the order of search; some may not exist. The built-in set comes last."""
    chosen = os.environ.get(TRACKS_VARIABLE, "").split(os.pathsep)
    return [*(Path(folder).expanduser() for folder in chosen if folder.strip()), cache_folder()]


def list_tracks() -> list[TrackEntry]:
    """Every track that a name finds, in the order of search; of two with one name, the first."""
    found: dict[str, TrackEntry] = {}
    for folder in search_path():
        source = "cache" if folder == cache_folder() else "folder"
        for path in _track_folders(folder):
            name = _name_of(path)
            found.setdefault(name, TrackEntry(name, source, path))
    for name in BUILTIN_TRAIN + BUILTIN_HELD_OUT:
        split = "train" if name in BUILTIN_TRAIN else "held_out"
        found.setdefault(name, TrackEntry(name, "builtin", split=split))
    return list(found.values())


def find_track(name: str) -> Track:
    """Load the track called `name`: exactly so, else whatever its case, spaces, punctuation and accents.

    Raises:
        OutlapError: no track has this name, or its files are not valid.
    """
    return find_entry(name).load()


def find_entry(name: str) -> TrackEntry:
    """Where `find_track` finds `name`, nothing loaded; raises OutlapError where no track has this name."""
    entries, key = list_tracks(), name_key(name)
    same = [entry for entry in entries if entry.name == name]
    alike = [entry for entry in entries if key and name_key(entry.name) == key]
    if same or alike:
        return (same or alike)[0]
    raise OutlapError(_not_found(name, entries))


def name_key(name: str) -> str:
    """What remains of a name without case, spaces, punctuation and accents: São Paulo is SaoPaulo."""
    # Umlauts are written as two letters in the archive's names (Nürburgring, Nuerburgring).
    composed = unicodedata.normalize("NFC", name).casefold()
    spelled = composed.replace("ä", "ae").replace("ö", "oe").replace("ü", "ue")
    return "".join(c for c in unicodedata.normalize("NFKD", spelled) if c.isalnum())


def is_track_folder(path: Path) -> bool:
    """Whether `path` is a folder with a map yaml, valid or not."""
    return path.is_dir() and bool(map_io.find_yaml_files(path))


def _track_folders(folder: Path) -> list[Path]:
    try:
        children = sorted(folder.iterdir())
    except OSError:  # absent or unreadable: _not_found says so
        return []
    return [path for path in children if not path.name.startswith(".") and is_track_folder(path)]


def _name_of(folder: Path) -> str:
    """The folder's name, in the spelling of its map file: `Mexico City/MexicoCity_map.yaml` is MexicoCity."""
    spellings = [path.stem.removesuffix("_map") for path in map_io.find_yaml_files(folder)]
    return next((name for name in spellings if name_key(name) == name_key(folder.name)), folder.name)


def _not_found(name: str, entries: list[TrackEntry]) -> str:
    by_key = {name_key(candidate): candidate for candidate in (*OFFICIAL_TRACKS, *(e.name for e in entries))}
    close = [by_key[key] for key in difflib.get_close_matches(name_key(name), by_key, n=3, cutoff=0.6)]
    available = {entry.name for entry in entries}
    looked = ", ".join(f"{folder}{'' if folder.is_dir() else ' (absent)'}" for folder in search_path())
    message = f"no track is called {name!r}"
    if near := [candidate for candidate in close if candidate in available]:
        message += f"; did you mean {' or '.join(near)}?"
    message += f"; looked in {looked} and the built-in set ({TRACKS_VARIABLE} can name more folders)"
    if official := [candidate for candidate in close if candidate not in available]:
        message += f"; to download: outlap tracks download {official[0]}"
    return message
