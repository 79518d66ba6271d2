"""Finding tracks by name, and listing them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from outlap.errors import OutlapError
from outlap.track import load_track
from outlap.track.cache import cache_folder
from outlap.track.catalog import find_entry, find_track, list_tracks, name_key, search_path
from outlap.track.generate import BUILTIN_HELD_OUT, BUILTIN_TRAIN
from outlap.track.map_io import write_track
from track_archives import LENGTH, circle_track


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path, Path]:
    """Two folders of OUTLAP_TRACKS and the cache, all empty."""
    first, second = tmp_path / "first", tmp_path / "second"
    monkeypatch.setenv("OUTLAP_TRACKS", f"{first}{os.pathsep}{os.pathsep}{second}")
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path / "user"))
    cache = tmp_path / "user" / "tracks"
    for folder in (first, second, cache):
        folder.mkdir(parents=True)
    return first, second, cache


def put(place: Path, name: str, radius: float = 4.0, folder: str | None = None) -> Path:
    return write_track(circle_track(name, radius), place / (folder or name))


def test_search_path(places):
    assert search_path() == list(places)


def test_the_cache_is_the_platforms_unless_chosen(monkeypatch, tmp_path):
    monkeypatch.delenv("OUTLAP_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # where the platform is Linux
    assert cache_folder().parts[-2:] == ("outlap", "tracks")


def test_the_order_is_folders_then_cache_then_builtin(places):
    first, second, cache = places
    builtin = BUILTIN_TRAIN[0]
    for name, folder in [
        ("A", first),
        ("A", second),
        ("A", cache),
        ("B", second),
        ("B", cache),
        (builtin, cache),
    ]:
        put(folder, name)
    entries = {entry.name: entry for entry in list_tracks()}
    assert (entries["A"].source, entries["A"].path) == ("folder", first / "A")
    assert (entries["B"].source, entries["B"].path) == ("folder", second / "B")
    assert (entries[builtin].source, entries[builtin].path) == ("cache", cache / builtin)
    assert len(entries) == len(list_tracks())


def test_builtin_tracks_are_listed_with_their_split(places):
    entries = list_tracks()
    assert [e.name for e in entries if e.split == "train"] == list(BUILTIN_TRAIN)
    assert [e.name for e in entries if e.split == "held_out"] == list(BUILTIN_HELD_OUT)
    assert all(e.source == "builtin" and e.path is None for e in entries)
    assert len(BUILTIN_TRAIN) >= 10
    assert len(BUILTIN_HELD_OUT) == 3


def test_a_builtin_track_is_as_long_as_listed():
    entry = find_entry(BUILTIN_HELD_OUT[0])
    assert entry.load().centerline.length == pytest.approx(entry.length(), rel=1e-3)


def test_an_explicit_path_wins_over_a_name(places, tmp_path, monkeypatch):
    put(places[0], "Loop", radius=4.0)
    put(tmp_path / "here", "Loop", radius=6.0)
    monkeypatch.chdir(tmp_path / "here")
    assert load_track("./Loop").centerline.length == pytest.approx(LENGTH * 6 / 4, rel=1e-4)
    monkeypatch.chdir(tmp_path)
    assert load_track("Loop").centerline.length == pytest.approx(LENGTH, rel=1e-4)


def test_an_exact_name_wins_over_a_similar_one(places):
    put(places[0], "loop", radius=4.0)
    put(places[1], "Loop", radius=6.0)
    assert find_entry("Loop").path == places[1] / "Loop"
    assert find_entry("loop").path == places[0] / "loop"
    assert find_entry("LOOP").path == places[0] / "loop"  # the first found


@pytest.mark.parametrize("name", ["Mexico City", "MexicoCity", "mexico_city", "México-City", "MEXICO CITY"])
def test_case_spaces_and_accents_do_not_matter(places, name):
    put(places[1], "MexicoCity", folder="Mexico City")
    track = find_track(name)
    assert track.name == "MexicoCity"
    assert [entry.name for entry in list_tracks() if entry.path] == ["MexicoCity"]


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("São Paulo", "SaoPaulo"),
        ("Nürburgring", "NUERBURGRING"),
        ("Nu\u0308rburgring", "Nuerburgring"),  # the accent as a character of its own, as macOS writes it
        ("Straße", "strasse"),
    ],
)
def test_name_key(written, meant):
    assert name_key(written) == name_key(meant)


def test_name_key_tells_names_apart():
    names = ["Spa", "Sepang", "Loop1", "Loop2", "Nuerburgring", "Norisring"]
    assert len({name_key(name) for name in names}) == len(names)


def test_a_folder_with_another_name_than_its_map_goes_by_the_folder(places):
    put(places[0], "Loop", folder="narrow loop")
    assert find_track("narrow loop").name == "narrow loop"
    with pytest.raises(OutlapError, match="no track is called 'Loop'"):
        find_track("Loop")


def test_an_unknown_name_says_what_is_close_where_it_looked_and_how_to_get_it(places):
    put(places[0], "Circle")
    places[1].rmdir()
    with pytest.raises(OutlapError) as caught:
        find_track("Cirle")
    message = str(caught.value)
    assert "did you mean Circle?" in message
    assert f"{places[0]}, {places[1]} (absent), {places[2]} and the built-in set" in message
    assert "\n" not in message
    with pytest.raises(OutlapError, match="to download: outlap tracks download SaoPaulo"):
        find_track("são paolo")


@pytest.mark.parametrize("name", ["", " ", "--", "é\u0301"])
def test_names_of_nothing(places, name):
    put(places[0], "Circle")
    with pytest.raises(OutlapError):
        find_track(name)


def test_what_is_no_track_is_not_listed(places):
    first, _, cache = places
    put(first, "Circle")
    put(cache, "Half", folder=".staging-1234")
    (first / "notes").mkdir()
    (first / "notes" / "readme.txt").write_text("no map here")
    (first / "file.yaml").write_text("image: x.png")
    assert [entry.name for entry in list_tracks() if entry.path] == ["Circle"]


def test_length_needs_no_image(places):
    folder = put(places[0], "Circle")
    (folder / "Circle_map.png").unlink()
    assert find_entry("Circle").length() == pytest.approx(LENGTH, rel=1e-5)
    with pytest.raises(OutlapError, match=r"Circle_map\.png"):
        find_track("Circle")


def test_length_of_a_folder_without_a_centreline(places):
    folder = put(places[0], "Circle")
    (folder / "Circle_centerline.csv").unlink()
    with pytest.raises(OutlapError, match=r"has no Circle_centerline\.csv"):
        find_entry("Circle").length()


def test_real_circuits_by_name(real_tracks):
    for entry in list_tracks():
        if entry.path is not None and entry.path.parent == real_tracks:
            assert find_track(entry.name.upper()).name == entry.name
            assert find_track(entry.name).centerline.length == pytest.approx(entry.length())
