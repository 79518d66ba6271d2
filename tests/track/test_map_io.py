"""Map folders: what map_server would read, what is written, and one clear line for what is wrong."""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from outlap.errors import OutlapError
from outlap.track import Centerline, Raceline, Track, load_track
from outlap.track.map_image import read_map
from outlap.track.map_io import (
    read_centerline_csv,
    read_raceline_csv,
    read_track,
    read_tum_centerline,
    write_track,
)
from outlap.track.walls import draw_walls

MAP = {
    "image": "oval_map.png",
    "resolution": 0.1,
    "origin": [-12.5, -7.5, 0.0],
    "negate": 0,
    "occupied_thresh": 0.45,
    "free_thresh": 0.196,
}


def oval_points(count: int = 80) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([10.0 * np.cos(angle), 5.0 * np.sin(angle)])


def oval() -> Track:
    line = Centerline.from_points(oval_points(), 1.0, np.linspace(1.0, 1.5, 80))
    occupancy, origin = draw_walls(line, 0.1, 0.5)
    rng = np.random.default_rng(11)
    return Track("oval", occupancy, 0.1, origin, line, Raceline(np.arange(9.0), *rng.normal(size=(6, 9))))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map folder made by hand: 250 x 150 pixels of white."""
    path = tmp_path / "oval"
    path.mkdir()
    Image.fromarray(np.full((150, 250), 255, np.uint8)).save(path / "oval_map.png")
    write_yaml(path)
    rows = "\n".join(f"{x}, {y}, 1.0, 1.1" for x, y in oval_points())
    (path / "oval_centerline.csv").write_text(f"# x_m, y_m, w_tr_right_m, w_tr_left_m\n{rows}\n")
    return path


def write_yaml(folder: Path, name: str = "oval_map.yaml", **changes: object) -> None:
    (folder / name).write_text(yaml.safe_dump(MAP | changes))


def assert_same(a: Track, b: Track) -> None:
    np.testing.assert_array_equal(a.occupancy, b.occupancy)
    assert (a.name, a.resolution, a.origin) == (b.name, b.resolution, b.origin)
    for name in ("s", "points", "width_right", "width_left", "length"):
        np.testing.assert_array_equal(getattr(a.centerline, name), getattr(b.centerline, name))
    assert (a.raceline is None) == (b.raceline is None)
    if a.raceline is not None and b.raceline is not None:
        for name in ("s", "x", "y", "heading", "curvature", "speed", "acceleration"):
            np.testing.assert_array_equal(getattr(a.raceline, name), getattr(b.raceline, name))


@pytest.mark.parametrize("folder_name", ["oval", "another name"])
def test_what_is_written_reads_back_the_same(tmp_path: Path, folder_name: str) -> None:
    track = oval()
    empty = np.zeros((400, 500), dtype=bool)
    turned = Track("oval", empty, 0.1 / 3.0 + 0.05, (-15.0 - 1e-7, -11.0 - 1.0 / 3.0, 1e-3), track.centerline)
    for written in (track, turned):
        assert write_track(written, tmp_path / folder_name) == tmp_path / folder_name
        assert_same(read_track(tmp_path / folder_name), written)
    assert sorted(path.name for path in (tmp_path / folder_name).iterdir()) == [
        "oval_centerline.csv",
        "oval_map.png",
        "oval_map.yaml",
    ]  # nothing half-written, and no racing line of the track before


def test_a_name_with_a_space_and_one_that_is_no_file_name(tmp_path: Path) -> None:
    source = oval()
    spaced = Track("Mexico City", source.occupancy, 0.1, source.origin, source.centerline)
    assert_same(load_track(write_track(spaced, tmp_path / "Mexico City")), spaced)
    for name in ("", "a/b", "..", "a\nb"):
        with pytest.raises(OutlapError, match="cannot be a file's name"):
            write_track(Track(name, source.occupancy, 0.1, source.origin, source.centerline), tmp_path / "x")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutlapError, match="file: cannot be made"):
        write_track(source, tmp_path / "file")


@pytest.mark.parametrize("circuit", ["Spielberg", "levine"])
def test_real_circuits_read_back_the_same(real_tracks: Path, tmp_path: Path, circuit: str) -> None:
    track = load_track(real_tracks / circuit)
    assert track.name == circuit
    assert track.raceline is not None
    assert_same(load_track(write_track(track, tmp_path / circuit)), track)


@pytest.mark.parametrize(
    "name", ["oval_map.yaml", "oval.yaml", "oval.yml", "something.yaml", "map.yaml", "oval dry_map.yaml"]
)
def test_the_yaml_may_have_other_names(folder: Path, name: str) -> None:
    (folder / "oval_map.yaml").rename(folder / name)
    track = read_track(folder)
    assert track.name == {"something.yaml": "something", "oval dry_map.yaml": "oval dry"}.get(name, "oval")
    assert track.raceline is None


def test_the_folder_s_own_yaml_wins_and_two_strangers_are_refused(folder: Path) -> None:
    write_yaml(folder, "other.yaml", resolution=0.3)
    assert read_track(folder).resolution == 0.1
    (folder / "oval_map.yaml").rename(folder / "third.yaml")
    with pytest.raises(OutlapError, match=r"has 2 yaml files \(other.yaml, third.yaml\)"):
        read_track(folder)


def test_image_rows_run_from_the_top(folder: Path) -> None:
    pixels = np.full((150, 250), 255, np.uint8)
    pixels[2, 40] = 0  # third row from the top
    Image.fromarray(pixels).save(folder / "oval_map.png")
    track = read_track(folder)
    assert np.argwhere(track.occupancy).tolist() == [[147, 40]]
    assert track.is_wall(-12.5 + 4.05, -7.5 + 14.75)


@pytest.mark.parametrize(
    ("negate", "thresh", "wall_from", "wall_to"),
    [
        (0, 0.45, 0, 140),  # (255 - 140) / 255 = 0.45098 is above 0.45, 114 / 255 is not
        (0, 0.65, 0, 89),  # 166 / 255 = 0.65098
        (0, 0.2, 0, 203),  # 51 / 255 is 0.2 exactly: not above
        (1, 0.65, 166, 255),
        (True, 0.2, 52, 255),
    ],
)
def test_thresholds_and_negate_are_map_server_s(
    folder: Path, negate: int, thresh: float, wall_from: int, wall_to: int
) -> None:
    Image.fromarray(np.arange(256, dtype=np.uint8)[None].repeat(4, axis=0)).save(folder / "oval_map.png")
    write_yaml(folder, resolution=1.0, origin=[-300, -300, 0], negate=negate, occupied_thresh=thresh)
    walls = np.flatnonzero(read_map(folder / "oval_map.yaml").occupancy[0])
    assert (walls[0], walls[-1], len(walls)) == (wall_from, wall_to, wall_to - wall_from + 1)


def grey_patches() -> np.ndarray:
    """Four patches: black, dark grey (a wall), light grey and white (free)."""
    pixels = np.full((150, 250), 255, np.uint8)
    pixels[:10, :10], pixels[:10, 10:20], pixels[:10, 20:30] = 0, 100, 200
    return pixels


def save_as(kind: str, path: Path) -> None:
    grey = Image.fromarray(grey_patches())
    match kind:
        case "pgm" | "png":
            grey.save(path)
        case "pgm16":
            big_endian = (grey_patches().astype(np.uint16) * 257).astype(">u2").tobytes()
            path.write_bytes(b"P5\n# a comment\n250 150\n65535\n" + big_endian)
        case "pgm100":
            path.write_bytes(b"P5 250 150 100\n" + (grey_patches().astype(int) * 100 // 255).astype("u1").tobytes())
        case "png16":
            Image.fromarray(grey_patches().astype(np.uint16) * 257).save(path)
        case "RGB" | "LA" | "RGBA":
            grey.convert(kind).save(path)
        case "palette":
            grey.convert("P").save(path)
        case "bits":
            Image.fromarray(grey_patches() > 150).save(path)


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        ("png", "png"),
        ("pgm", "pgm"),
        ("pgm16", "pgm"),
        ("pgm100", "pgm"),
        ("png16", "png"),
        ("RGB", "png"),
        ("palette", "png"),
        ("bits", "png"),
    ],
)
def test_every_kind_of_image_gives_the_same_walls(folder: Path, kind: str, suffix: str) -> None:
    save_as(kind, folder / f"a.{suffix}")
    write_yaml(folder, image=f"a.{suffix}")
    expected = np.zeros((150, 250), dtype=bool)
    expected[-10:, :20] = True
    np.testing.assert_array_equal(read_track(folder).occupancy, expected)


@pytest.mark.parametrize("kind", ["LA", "RGBA"])
def test_alpha_is_averaged_in_trinary_mode_and_ignored_in_scale_mode(folder: Path, kind: str) -> None:
    save_as(kind, folder / "oval_map.png")
    # opaque: dark grey averages (3 · 100 + 255) / 4 = 138.75, so p = 0.456; black 63.75, p = 0.75
    for mode, thresh, walls in [("trinary", 0.45, 200), ("trinary", 0.46, 100), ("scale", 0.46, 200)]:
        write_yaml(folder, mode=mode, occupied_thresh=thresh)
        assert read_track(folder).occupancy.sum() == walls


def test_yaw_and_numbers_written_as_text(folder: Path) -> None:
    write_yaml(folder, resolution="2e-1", origin=[0.0, -25.0, 0.7853981633974483])
    track = read_track(folder)
    assert track.resolution == 0.2
    assert track.origin == (0.0, -25.0, 0.7853981633974483)


def one_line(error: pytest.ExceptionInfo[OutlapError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resolution": 0.0}, "resolution is 0.0; it must be a positive number of metres per pixel"),
        ({"resolution": -0.05}, "resolution is -0.05; it must be a positive"),
        ({"resolution": float("nan")}, "resolution is nan; it must be a positive"),
        ({"resolution": "fine"}, "resolution is 'fine'; it must be a positive"),
        ({"resolution": None}, "resolution is missing"),
        ({"image": None}, "image is missing"),
        ({"image": 7}, "image is 7; it must be the name of a file"),
        ({"image": "a\0b"}, "image is .*; it must be the name of a file"),
        ({"image": "gone.png"}, "image is 'gone.png'; there is no such file in the folder"),
        ({"image": "../secret.png"}, "image is '../secret.png'; it must not lead out of the folder"),
        ({"image": "/etc/passwd"}, "image is '/etc/passwd'; it must not lead out of the folder"),
        ({"image": "link.png"}, "image is 'link.png'; it must not lead out of the folder"),
        ({"image": "."}, "there is no such file"),
        ({"origin": [0.0, 0.0]}, r"origin is \[0.0, 0.0\]; it must be \[x, y, yaw\]"),
        ({"origin": [0.0, "east", 0.0]}, r"origin is .*; it must be \[x, y, yaw\]"),
        ({"origin": [0.0, float("inf"), 0.0]}, r"origin is .*, all finite"),
        ({"origin": 3}, r"origin is 3; it must be"),
        ({"negate": 2}, "negate is 2; it must be 0 or 1"),
        ({"occupied_thresh": 1.5}, "occupied_thresh is 1.5; it must be a number from 0 to 1"),
        ({"occupied_thresh": True}, "occupied_thresh is True; it must be a number"),
        ({"free_thresh": 0.9}, "free_thresh is 0.9; it must not be above occupied_thresh, 0.45"),
        ({"mode": "raw"}, "mode is 'raw'; it must be trinary or scale"),
    ],
)
def test_bad_yaml_fields_are_named(folder: Path, changes: dict[str, Any], message: str) -> None:
    Image.new("L", (250, 150), 255).save(folder.parent / "secret.png")
    (folder / "link.png").symlink_to(folder.parent / "secret.png")
    write_yaml(folder, **changes)
    with pytest.raises(OutlapError, match=message) as error:
        read_track(folder)
    assert one_line(error).startswith(f"{folder / 'oval_map.yaml'}: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image: [unclosed\nresolution: 3", "is not valid yaml at line 2: "),
        ("- a\n- list", r"holds \['a', 'list'\]; it must be a mapping"),
        ("", "holds None; it must be a mapping"),
        ("image: !!python/object/apply:os.system ['touch pwned']", "is not valid yaml at line 1"),
        ("a: \x00", "is not valid yaml"),
    ],
)
def test_bad_yaml_is_refused(folder: Path, text: str, message: str) -> None:
    (folder / "oval_map.yaml").write_text(text)
    with pytest.raises(OutlapError, match=message) as error:
        read_track(folder)
    assert one_line(error).startswith(f"{folder / 'oval_map.yaml'}: ")


def png_header(width: int, height: int) -> bytes:
    """The first bytes of a png that claims this size: enough to read the size, nothing to decode."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return start + struct.pack(">I", 1000) + b"IDAT"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png_header(10_001, 10_000), "has 10001 x 10000 pixels; it must have at most 100 million"),
        (png_header(60_000, 60_000), "has too many pixels; it must have at most 100 million"),
        (png_header(100, 100), "is not a readable image"),
        (b"", "is not a readable image; it must be a png or pgm"),
        (b"P5 250 150 255\n" + bytes(100), "is not a readable image"),
        (b"P5 250 -3 255\n" + bytes(100), "is not a readable image"),
        (b"Pf 2 2 -1.0\n" + bytes(16), "floating-point pixels"),
        (b"hello", "is not a readable image"),
    ],
    ids=["100.01 MP", "3600 MP", "no data", "empty", "truncated", "negative", "float", "text"],
)
def test_bad_images_are_refused(folder: Path, content: bytes, message: str) -> None:
    (folder / "oval_map.png").write_bytes(content)
    with pytest.raises(OutlapError, match=message) as error:
        read_track(folder)
    assert one_line(error).startswith(f"{folder / 'oval_map.png'}: ")


def test_an_image_of_almost_100_million_pixels_raises_no_warning(
    folder: Path, recwarn: pytest.WarningsRecorder
) -> None:
    (folder / "oval_map.png").write_bytes(png_header(9_999, 9_999))
    with pytest.raises(OutlapError, match="is not a readable image"):
        read_track(folder)
    assert not list(recwarn)


def test_a_folder_that_is_none_or_lacks_files(folder: Path) -> None:
    with pytest.raises(OutlapError, match="nothing: is not a folder"):
        read_track(folder / "nothing")
    (folder / "oval_centerline.csv").unlink()
    with pytest.raises(OutlapError, match=r"has no oval_centerline.csv; a track needs its centreline"):
        read_track(folder)
    (folder / "oval_map.yaml").unlink()
    with pytest.raises(OutlapError, match=r"has no yaml file; .* oval_map.yaml or oval.yaml"):
        read_track(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: rows,
        lambda rows: rows[1:],  # no header at all
        lambda rows: ["x_m,y_m,w_tr_right_m,w_tr_left_m", *rows[1:]],
        lambda rows: [*rows, rows[1]],  # closed
        lambda rows: [*rows[:5], "", "# note", rows[4], *rows[5:]],
        lambda rows: [row.replace(", ", ";") for row in rows],
        lambda rows: [f"\ufeff{rows[0]}", *(f"  {row} \r" for row in rows[1:])],
    ],
    ids=["as it is", "bare", "header", "closed", "repeated", "semicolons", "windows"],
)
def test_centreline_csv_variants_give_the_same_line(folder: Path, change) -> None:
    path = folder / "oval_centerline.csv"
    path.write_text("\n".join(change(path.read_text().splitlines())), encoding="utf-8")
    line = read_centerline_csv(path)
    np.testing.assert_array_equal(line.points, oval_points())
    np.testing.assert_array_equal(line.width_right, 1.0)
    np.testing.assert_array_equal(line.width_left, 1.1)


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (4, "1.0, nan, 1.0, 1.0", "line 4: y_m is 'nan'; it must be a finite number"),
        (4, "1.0, 2.0, inf, 1.0", "line 4: w_tr_right_m is 'inf'; it must be a finite number"),
        (5, "1.0, two, 1.0, 1.0", "line 5: y_m is 'two'; it must be a finite number"),
        (5, "1.0, , 1.0, 1.0", "line 5: y_m is ''; it must be a finite number"),
        (7, "1.0, 2.0, 3.0", "line 7: has 3 columns; it must have x_m, y_m, w_tr_right_m, w_tr_left_m"),
        (7, "1.0, 2.0, 3.0, 4.0, 5.0", "line 7: has 5 columns"),
        (9, "1.0, 2.0, 3.0, -0.1", "line 9: w_tr_left_m is -0.1; it must be zero or more metres"),
    ],
)
def test_bad_centreline_rows_are_named(folder: Path, line: int, text: str, message: str) -> None:
    path = folder / "oval_centerline.csv"
    rows = path.read_text().splitlines()
    rows[line - 1] = text
    path.write_text("\n".join(rows))
    for read in (lambda: read_track(folder), lambda: read_tum_centerline(path)):
        with pytest.raises(OutlapError, match=message) as error:
            read()
        assert one_line(error).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "has 0 points; it must have at least 4"),
        (["0,0,1,1", "1,0,1,1", "1,1,1,1"], "has 3 points; it must have at least 4"),
        (["0,0,1,1", "1,0,1,1", "1,1,1,1", "0,0,1,1"], "3 distinct points"),
        (["0,0,1,1"] * 9, "1 distinct points"),
    ],
)
def test_too_few_points_are_counted(folder: Path, rows: list[str], message: str) -> None:
    path = folder / "oval_centerline.csv"
    path.write_text("\n".join(rows))
    with pytest.raises(OutlapError, match=message) as error:
        read_track(folder)
    assert one_line(error).startswith(f"{path}: ")


def test_a_csv_that_is_no_text_or_is_missing(folder: Path) -> None:
    shutil.copy(folder / "oval_map.png", folder / "oval_centerline.csv")
    with pytest.raises(OutlapError, match=r"oval_centerline\.csv: is not a text file"):
        read_track(folder)
    with pytest.raises(OutlapError, match=r"gone\.csv: does not exist"):
        read_centerline_csv(folder / "gone.csv")


def test_a_thin_wall_across_the_centreline_is_found_between_its_points(folder: Path) -> None:
    pixels = np.full((150, 250), 255, np.uint8)
    pixels[20:30, 130] = 0  # one pixel thick, at x = 0.5 .. 0.6 over y = 4.5 .. 5.5; points are 0.8 m apart
    Image.fromarray(pixels).save(folder / "oval_map.png")
    with pytest.raises(OutlapError, match="passes through a wall at s = ") as error:
        read_track(folder)
    x = float(one_line(error).split("x_m = ")[1].split(",")[0])
    assert 0.5 <= x <= 0.6
    s = float(one_line(error).split("s = ")[1].split(" m")[0])
    np.testing.assert_allclose(Centerline.from_points(oval_points(), 1, 1).position(s)[0], x, atol=0.02)


def test_a_centreline_outside_the_map_is_named(folder: Path) -> None:
    write_yaml(folder, origin=[-9.0, -7.5, 0.0])
    with pytest.raises(OutlapError, match=r"oval_centerline.csv: the centreline leaves the map at s = "):
        read_track(folder)


def test_raceline_with_any_number_of_comment_lines(folder: Path) -> None:
    rows = np.random.default_rng(12).normal(size=(6, 7))
    rows[:, 0] = np.arange(6) * 0.2
    text = "\n".join("; ".join(map(repr, row)) for row in rows.tolist())
    path = folder / "oval_raceline.csv"
    for comments in (
        "",
        "# c85859c6\n# 603fd\n# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2\n",
        "#s_m\n",
    ):
        path.write_text(comments + text)
        line = read_track(folder).raceline
        assert line is not None
        got = [line.s, line.x, line.y, line.heading, line.curvature, line.speed, line.acceleration]
        np.testing.assert_array_equal(np.column_stack(got), rows)
    path.write_text(text.replace("0.2; ", "0.7; ", 1))
    with pytest.raises(OutlapError, match=r"line 3: s_m is 0\.4; it must be greater than in the row before"):
        read_raceline_csv(path)
    path.write_text("1; 2; 3")
    with pytest.raises(OutlapError, match=r"oval_raceline\.csv: line 1: has 3 columns"):
        read_track(folder)


@pytest.mark.parametrize("half_width", [None, 0.9])
def test_tum_centreline_is_scaled_and_walled(tmp_path: Path, half_width: float | None) -> None:
    path = tmp_path / "Ring.csv"
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    rows = "\n".join(f"{150 * np.cos(a)},{150 * np.sin(a)},8.0,6.0" for a in angle)
    path.write_text(f"# x_m,y_m,w_tr_right_m,w_tr_left_m\n{rows}\n")
    track = read_tum_centerline(path, half_width=half_width)
    assert track.name == "Ring"
    assert track.raceline is None
    assert track.centerline.length == pytest.approx(2.0 * np.pi * 15.0, rel=1e-5)
    right, left = (0.8, 0.6) if half_width is None else (half_width, half_width)
    free = (~track.occupancy).sum() * track.resolution**2
    assert free == pytest.approx(np.pi * ((15.0 + right) ** 2 - (15.0 - left) ** 2), rel=2e-3)
    assert_same(read_track(write_track(track, tmp_path / "saved")), track)
    np.testing.assert_allclose(load_track(path).centerline.length, track.centerline.length)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0.0}, "scale is 0.0; it must be a positive factor"),
        ({"half_width": -1.0}, "half_width is -1.0; it must be a positive number of metres"),
        ({"resolution": 0.0}, "resolution is 0.0; it must be a positive"),
        ({"resolution": 1e-4}, "resolution is 0.0001; it makes .* take a coarser one"),
    ],
)
def test_tum_arguments_are_checked(folder: Path, arguments: dict[str, float], message: str) -> None:
    with pytest.raises(OutlapError, match=message) as error:
        read_tum_centerline(folder / "oval_centerline.csv", **arguments)
    one_line(error)
