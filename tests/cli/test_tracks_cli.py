"""`outlap tracks`: each command as a user calls it, its JSON and its mistakes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from outlap.cli.main import main
from outlap.track import load_track
from outlap.track.generate import BUILTIN_HELD_OUT, BUILTIN_TRAIN
from outlap.track.map_io import write_track
from track_archives import LENGTH, ArchiveServer, circle_track, tar_xz, track_members


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache's folder, absent; OUTLAP_TRACKS is tmp_path/mine, and tmp_path/work the current folder."""
    monkeypatch.setenv("OUTLAP_CACHE", str(tmp_path / "user"))
    monkeypatch.setenv("OUTLAP_TRACKS", str(tmp_path / "mine"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "user" / "tracks"


@pytest.fixture
def run(cache: Path, capfd: pytest.CaptureFixture[str]):
    """Run `outlap tracks ...` that succeeds; gives its JSON."""

    def run(*words: str) -> Any:
        capfd.readouterr()
        code = main(["tracks", *words, "--json", "-"])
        out, err = capfd.readouterr()
        assert code == 0, err
        return json.loads(out)

    return run


@pytest.fixture
def fail(cache: Path, capfd: pytest.CaptureFixture[str]):
    """Run `outlap tracks ...` that has a mistake; gives its one line."""

    def fail(*words: str) -> str:
        capfd.readouterr()
        assert main(["tracks", *words]) == 2
        out, err = capfd.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        return err

    return fail


def tum_csv(path: Path, radius: float = 60.0) -> Path:
    """A circle of full scale, 8 m and 6 m wide, as in the TUM database."""
    angle = np.linspace(0, 2 * math.pi, 200, endpoint=False)
    rows = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0 * angle + 8, 0 * angle + 6))
    np.savetxt(path, rows, delimiter=",", header="x_m,y_m,w_tr_right_m,w_tr_left_m")
    return path


# --- list ---------------------------------------------------------------------------------------------------


def test_list_tells_names_sources_splits_and_lengths(run, tmp_path):
    folder = write_track(circle_track(), tmp_path / "mine" / "Circle")
    rows = {row["name"]: row for row in run("list")["tracks"]}
    assert rows.pop("Circle") == {
        "name": "Circle",
        "source": "folder",
        "length_m": pytest.approx(LENGTH, abs=1e-2),
        "path": str(folder),
    }
    assert {name for name, row in rows.items() if row["split"] == "train"} == set(BUILTIN_TRAIN)
    assert {name for name, row in rows.items() if row["split"] == "held_out"} == set(BUILTIN_HELD_OUT)
    assert all(row["source"] == "builtin" and row["length_m"] > 0 and row["path"] is None for row in rows.values())


def test_list_shows_what_is_wrong_with_a_folder_and_goes_on(run, tmp_path, capfd):
    broken = write_track(circle_track("Broken"), tmp_path / "mine" / "Broken")
    (broken / "Broken_centerline.csv").write_text("0, 0, nan, 1\n" * 20)
    write_track(circle_track(), tmp_path / "mine" / "Circle")
    rows = {row["name"]: row for row in run("list")["tracks"]}
    assert rows["Broken"]["length_m"] is None
    assert "Broken_centerline.csv" in rows["Broken"]["error"]
    assert "error" not in rows["Circle"]
    assert main(["tracks", "list"]) == 0
    shown = capfd.readouterr().out
    assert "Circle" in shown
    assert "25.1" in shown
    assert "nan" in shown


# --- show ---------------------------------------------------------------------------------------------------


def test_show_draws_a_picture_and_measures(cache, tmp_path, capfd):
    write_track(circle_track(), tmp_path / "mine" / "Circle")
    assert main(["tracks", "show", "circle", "--json", "found.json"]) == 0
    with Image.open("Circle.png") as picture:
        assert min(picture.size) >= 300
    found = json.loads(Path("found.json").read_text())
    assert found["picture"] == "Circle.png"
    assert found["length_m"] == pytest.approx(LENGTH, abs=1e-2)
    assert found["min_radius_m"] == pytest.approx(4.0, rel=1e-2)
    assert found["mean_width_m"] == found["min_width_m"] == pytest.approx(1.5)
    assert found["clockwise"] is False
    assert found["raceline"] is False
    shown = capfd.readouterr().out
    assert "picture: Circle.png" in shown
    assert "25.1 m anticlockwise, tightest radius 4.00 m, width 1.50 m" in shown


def test_show_says_what_is_wrong(fail, tmp_path):
    write_track(circle_track(), tmp_path / "mine" / "Circle")
    assert "did you mean Circle?" in fail("show", "Cirkle")
    assert "must be a file that ends in .png" in fail("show", "Circle", "--out", "picture.txt")
    assert "must be a file that ends in .png" in fail("show", "Circle", "--out", ".")
    assert "no/such/folder" in fail("show", "no/such/folder")


# --- generate -----------------------------------------------------------------------------------------------


def test_generate_writes_a_track_of_what_was_asked_for(run, tmp_path):
    made = run(
        *("generate", "--seed", "3", "--length", "120", "--width", "1.8"),
        *("--min-radius", "2", "--clockwise", "--out", "tracks/loop"),
    )
    track = load_track("tracks/loop")
    assert track.name == made["name"] == "loop"
    assert made["path"] == "tracks/loop"
    assert track.centerline.length == pytest.approx(120, rel=1e-3)
    assert made["min_width_m"] == pytest.approx(1.8)
    assert made["min_radius_m"] > 1.99
    x, y = track.centerline.position(np.linspace(0, track.centerline.length, 2000)).T
    assert np.sum(x[:-1] * np.diff(y) - y[:-1] * np.diff(x)) < 0  # twice the signed area


def test_generate_in_both_directions_and_with_defaults(run):
    assert run("generate", "--seed", "5", "--length", "100", "--anticlockwise", "--name", "left")["clockwise"] is False
    assert load_track("./left").name == "left"
    assert run("generate", "--seed", "5", "--length", "100")["path"] == "generated-5"


def test_generate_says_what_is_wrong(fail):
    assert "exclude each other" in fail("generate", "--seed", "1", "--clockwise", "--anticlockwise")
    assert "width" in fail("generate", "--seed", "1", "--width", "-1")
    assert "--seed" in fail("generate")
    assert "name '../x'" in fail("generate", "--seed", "1", "--length", "100", "--name", "../x", "--out", "here")
    assert not Path("here").exists()
    Path("full").mkdir()
    Path("full/letter.txt").write_text("mine")
    assert "must be an empty or a new folder" in fail("generate", "--seed", "1", "--out", "full")


# --- import -------------------------------------------------------------------------------------------------


def test_import_of_a_tum_csv_is_found_by_its_name(run, cache):
    tum_csv(Path("Round.csv"))
    made = run("import", "Round.csv")
    assert made["path"] == str(cache / "Round")
    assert [row["source"] for row in run("list")["tracks"] if row["name"] == "Round"] == ["cache"]
    track = load_track("round")
    assert track.centerline.length == pytest.approx(2 * math.pi * 6.0, rel=1e-4)  # 1:10
    assert [float(w) for w in track.centerline.widths(1.0)] == pytest.approx([0.8, 0.6])


def test_import_with_another_scale_width_and_name(run):
    tum_csv(Path("Round.csv"))
    run("import", "Round.csv", "--scale", "0.05", "--half-width", "1.1", "--name", "Round 20")
    track = load_track("Round 20")
    assert track.name == "Round 20"
    assert track.centerline.length == pytest.approx(2 * math.pi * 3.0, rel=1e-4)
    assert [float(w) for w in track.centerline.widths(1.0)] == pytest.approx([1.1, 1.1])


def test_import_of_a_map_folder_keeps_the_walls(run, tmp_path):
    original = circle_track("Circle")
    write_track(original, tmp_path / "somewhere" / "Circle")
    run("import", str(tmp_path / "somewhere" / "Circle"))
    stored = load_track("Circle")
    assert np.array_equal(stored.occupancy, original.occupancy)
    assert (stored.resolution, stored.origin) == (original.resolution, original.origin)


def test_import_replaces_only_with_force(run, fail, cache):
    tum_csv(Path("Round.csv"), radius=60.0)
    run("import", "Round.csv")
    tum_csv(Path("Round.csv"), radius=80.0)
    assert "--force" in fail("import", "Round.csv")
    assert load_track("Round").centerline.length == pytest.approx(2 * math.pi * 6.0, rel=1e-4)
    run("import", "Round.csv", "--force")
    assert load_track("Round").centerline.length == pytest.approx(2 * math.pi * 8.0, rel=1e-4)
    assert [path.name for path in cache.iterdir() if path.name != ".lock"] == ["Round"]


def test_import_to_a_folder_leaves_the_cache_alone(run, fail, cache):
    tum_csv(Path("Round.csv"))
    assert run("import", "Round.csv", "--out", "maps/Round")["path"] == "maps/Round"
    assert load_track("maps/Round").name == "Round"
    assert not cache.exists()
    assert "must be an empty or a new folder" in fail("import", "Round.csv", "--out", "maps/Round")


def test_import_tells_of_a_name_that_is_found_elsewhere_first(run, tmp_path, capfd):
    write_track(circle_track("Round"), tmp_path / "mine" / "Round")
    tum_csv(Path("Round.csv"))
    assert main(["tracks", "import", "Round.csv"]) == 0
    assert f"{tmp_path / 'mine' / 'Round'} has this name too and is found first" in capfd.readouterr().out


def test_import_says_what_is_wrong(fail, cache, tmp_path):
    assert "missing.csv: does not exist" in fail("import", "missing.csv")
    Path("Short.csv").write_text("0,0,1,1\n1,0,1,1\n")
    assert "Short.csv" in fail("import", "Short.csv")
    tum_csv(Path("Round.csv"))
    assert "scale" in fail("import", "Round.csv", "--scale", "0")
    for name in ("../evil", "/evil", "..", ""):
        assert "cannot be a file's name" in fail("import", "Round.csv", "--name", name)
    write_track(circle_track(), tmp_path / "somewhere")
    assert "--scale and --half-width" in fail("import", str(tmp_path / "somewhere"), "--scale", "0.1")
    assert [path for path in cache.iterdir() if path.name != ".lock"] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["somewhere", "user", "work"]


# --- download -----------------------------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    server = ArchiveServer()
    yield server
    server.close()


def test_download(run, cache, server, tmp_path, capfd):
    server.answers["/Monza.tar.xz"] = tar_xz(track_members(tmp_path / "made", "Monza"))
    (row,) = run("download", "monza", "--url", server.url_template)["tracks"]
    assert (row["name"], row["status"], row["path"]) == ("Monza", "downloaded", str(cache / "Monza"))
    assert set(row) == {"name", "status", "path", "url", "sha256", "size_bytes"}
    assert main(["tracks", "download", "Monza", "--url", server.url_template]) == 0
    assert capfd.readouterr().out == f"Monza present: {cache / 'Monza'}\n"
    assert load_track("Monza").name == "Monza"


def test_download_says_what_is_wrong(fail, server):
    assert "or --all" in fail("download")
    assert "or --all" in fail("download", "Monza", "--all")
    assert "must hold {name}" in fail("download", "Monza", "--url", "https://127.0.0.1/x.tar.xz")
    assert "404 Not Found" in fail("download", "Monza", "--url", server.url_template)
    assert "only https" in fail("download", "Monza", "--url", "http://example.org/{name}.tar.xz")
