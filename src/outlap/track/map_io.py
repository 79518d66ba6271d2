"""Tracks on disk: the F1TENTH map folder, read and written; the TUM centreline csv, read.

A map folder holds a ROS map_server yaml with its image, `NAME_centerline.csv` and, where somebody
made one, `NAME_raceline.csv`.
"""

from __future__ import annotations

import io
import math
import os
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from outlap.errors import OutlapError, short_repr
from outlap.files import atomic_write
from outlap.track.centerline import MIN_POINTS, Centerline
from outlap.track.map_image import read_map, read_text
from outlap.track.raceline import Raceline
from outlap.track.track import Track
from outlap.track.walls import draw_walls

CENTERLINE_COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
RACELINE_COLUMNS = ("s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps", "ax_mps2")

_WALL_MARGIN = 0.5  # [m] solid wall around a track drawn from its widths


def read_track(folder: str | os.PathLike[str]) -> Track:
    """Read an F1TENTH map folder.

    Takes `NAME_map.yaml`, `NAME.yaml` or the folder's only yaml; `NAME_centerline.csv` or the only
    one; `NAME_raceline.csv` if it is there. Raises OutlapError, which names the file and the field.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise OutlapError(f"{folder}: is not a folder; give a map folder with NAME_map.yaml in it")
    here = folder.resolve().name
    yaml_path = _only_file(folder, [f"{here}_map.yaml", f"{here}.yaml"], (".yaml", ".yml"), "yaml files")
    if yaml_path is None:
        raise OutlapError(f"{folder}: has no yaml file; a map folder holds {here}_map.yaml or {here}.yaml")
    name = yaml_path.stem.removesuffix("_map")
    name = here if name in ("", "map") else name
    map_image = read_map(yaml_path)
    centerline_path = find_centerline_csv(folder, name)
    raceline_path = _csv_beside(folder, name, "_raceline.csv")
    track = Track(
        name=name,
        occupancy=map_image.occupancy,
        resolution=map_image.resolution,
        origin=map_image.origin,
        centerline=read_centerline_csv(centerline_path),
        raceline=None if raceline_path is None else read_raceline_csv(raceline_path),
    )
    _require_clear_centerline(track, centerline_path)
    return track


def write_track(track: Track, folder: str | os.PathLike[str]) -> Path:
    """Write `track` to `folder` in the F1TENTH format, file by file and each at once; returns the folder.

    `NAME_map.yaml` comes last: without it the folder is no map. A racing line that the track does
    not have is removed from the folder.
    """
    folder = Path(folder)
    name = track.name
    if not name or name.startswith(".") or set(name) & set('/\\\0\n\r:"'):
        raise OutlapError(f"track name {name!r}: cannot be a file's name; use letters, digits, spaces, - and _")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutlapError(f"{folder}: cannot be made: {error.strerror}; give a folder") from None
    picture = io.BytesIO()
    pixels = np.where(track.occupancy[::-1], 0, 255).astype(np.uint8)
    Image.fromarray(pixels).save(picture, format="PNG")
    atomic_write(folder / f"{name}_map.png", picture.getvalue())

    line = track.centerline
    columns = np.column_stack([line.points, line.width_right, line.width_left])
    atomic_write(folder / f"{name}_centerline.csv", _csv_text(CENTERLINE_COLUMNS, columns, ", "))
    raceline_path = folder / f"{name}_raceline.csv"
    if track.raceline is None:
        raceline_path.unlink(missing_ok=True)
    else:
        write_raceline_csv(track.raceline, raceline_path)

    fields = {
        "image": f"{name}_map.png",
        "resolution": float(track.resolution),
        "origin": [float(value) for value in track.origin],
        "negate": 0,
        "occupied_thresh": 0.45,
        "free_thresh": 0.196,
    }
    text = yaml.safe_dump(fields, sort_keys=False, default_flow_style=None, allow_unicode=True)
    atomic_write(folder / f"{name}_map.yaml", text)
    return folder


def read_tum_centerline(
    csv: str | os.PathLike[str],
    scale: float = 0.1,
    half_width: float | None = None,
    resolution: float = 0.05,
) -> Track:
    """Make a track from a centreline csv of the TUM racetrack database: walls are drawn from the widths.

    Arguments: `scale` multiplies positions and widths (the files are full scale: 0.1 gives 1:10);
    `half_width` [m] replaces the widths on both sides, after scaling; `resolution` [m/pixel].
    Where two parts of the track come closer than their widths, there is no wall between them.
    """
    path = Path(csv)
    _require_positive("scale", scale, "a positive factor")
    if half_width is not None:
        _require_positive("half_width", half_width, "a positive number of metres")
    points, right, left = _read_centerline_columns(path)
    right, left = (right * scale, left * scale) if half_width is None else (half_width, half_width)
    try:
        line = Centerline.from_points(points * scale, right, left)
        occupancy, origin = draw_walls(line, resolution, margin=_WALL_MARGIN)
    except OutlapError as error:
        raise OutlapError(f"{path}: {error}") from None
    track = Track(path.stem.removesuffix("_centerline") or path.stem, occupancy, resolution, origin, line)
    _require_clear_centerline(track, path)
    return track


def read_centerline_csv(path: str | os.PathLike[str]) -> Centerline:
    """Read `x_m, y_m, w_tr_right_m, w_tr_left_m`; a last point that repeats the first is dropped."""
    points, right, left = _read_centerline_columns(Path(path))
    try:
        return Centerline.from_points(points, right, left)
    except OutlapError as error:
        raise OutlapError(f"{path}: {error}") from None


def read_raceline_csv(path: str | os.PathLike[str]) -> Raceline:
    """Read `s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2` after any number of comment lines."""
    path = Path(path)
    rows, lines = _read_csv(path, RACELINE_COLUMNS)
    back = np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)
    if back.size:
        raise OutlapError(
            f"{path}: line {lines[back[0] + 1]}: s_m is {rows[back[0] + 1, 0]}; "
            "it must be greater than in the row before"
        )
    return Raceline(*(_read_only(column) for column in rows.T))


def read_number_columns(path: str | os.PathLike[str], columns: tuple[str, ...]) -> np.ndarray:
    """The numbers (rows, columns) of a csv with these columns, and , or ; between them; comments are left out."""
    return _read_csv(Path(path), columns, least=1)[0]


def write_raceline_csv(line: Raceline, path: str | os.PathLike[str]) -> Path:
    """Write what `read_raceline_csv` reads; returns the path."""
    columns = np.column_stack([line.s, line.x, line.y, line.heading, line.curvature, line.speed, line.acceleration])
    return atomic_write(path, _csv_text(RACELINE_COLUMNS, columns, "; "))


def find_yaml_files(folder: Path) -> list[Path]:
    """Return the yaml files in `folder`, sorted; hidden ones are left out."""
    return _visible_files(folder, (".yaml", ".yml"))


def find_centerline_csv(folder: Path, name: str) -> Path:
    """Return `NAME_centerline.csv` or the folder's only such file; raise OutlapError if there is none."""
    path = _csv_beside(folder, name, "_centerline.csv")
    if path is None:
        raise OutlapError(f"{folder}: has no {name}_centerline.csv; a track needs its centreline")
    return path


def _visible_files(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    try:
        found = [path for path in folder.iterdir() if path.name[0] != "." and path.name.lower().endswith(endings)]
        return sorted(path for path in found if path.is_file())
    except OSError as error:
        raise OutlapError(f"{folder}: cannot be read: {error.strerror}") from None


def _csv_beside(folder: Path, name: str, ending: str) -> Path | None:
    names = [f"{name}{ending}", f"{folder.resolve().name}{ending}"]
    return _only_file(folder, names, (ending,), f"files *{ending}")


def _only_file(folder: Path, names: list[str], endings: tuple[str, ...], what: str) -> Path | None:
    """Return the first of `names` that is in the folder, else its only visible file with one of the endings."""
    for path in (folder / name for name in names):
        if path.is_file():
            return path
    found = _visible_files(folder, endings)
    if len(found) > 1:
        listed = ", ".join(path.name for path in found[:5])
        raise OutlapError(f"{folder}: has {len(found)} {what} ({listed}); name the map's {names[0]}")
    return found[0] if found else None


def _read_centerline_columns(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, lines = _read_csv(path, CENTERLINE_COLUMNS)
    for column in (2, 3):
        bad = np.flatnonzero(rows[:, column] < 0.0)
        if bad.size:
            raise OutlapError(
                f"{path}: line {lines[bad[0]]}: {CENTERLINE_COLUMNS[column]} is {rows[bad[0], column]}; "
                "it must be zero or more metres"
            )
    return rows[:, :2], rows[:, 2], rows[:, 3]


def _read_csv(path: Path, columns: tuple[str, ...], least: int = MIN_POINTS) -> tuple[np.ndarray, list[int]]:
    """The numbers (rows, columns) of a csv with , or ; between them, and the line each row stood in."""
    rows: list[list[float]] = []
    lines: list[int] = []
    expected = ", ".join(columns)
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in text.replace(";", ",").rstrip(" \t,").split(",")]
        numbers = [_cell(cell) for cell in cells]
        if not rows and all(number is None for number in numbers):
            continue  # a header without its #
        if len(cells) != len(columns):
            raise OutlapError(f"{path}: line {line}: has {len(cells)} columns; it must have {expected}")
        row: list[float] = []
        for cell, number, column in zip(cells, numbers, columns, strict=True):
            if number is None or not math.isfinite(number):
                raise OutlapError(f"{path}: line {line}: {column} is {short_repr(cell)}; it must be a finite number")
            row.append(number)
        rows.append(row)
        lines.append(line)
    if len(rows) < least:
        raise OutlapError(f"{path}: has {len(rows)} points; it must have at least {least} rows of {expected}")
    return np.array(rows), lines


def _cell(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _csv_text(columns: tuple[str, ...], rows: np.ndarray, separator: str) -> str:
    lines = [f"# {separator.join(columns)}"]
    lines += [separator.join(map(repr, row)) for row in rows.tolist()]
    return "\n".join(lines) + "\n"


def _read_only(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.setflags(write=False)
    return values


def _require_positive(field: str, value: float, right: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise OutlapError(f"{field} is {value}; it must be {right}")


def _require_clear_centerline(track: Track, path: Path) -> None:
    """Raise OutlapError where the centreline leaves the map or touches a wall.

    Walls may be nearer than the widths say, in real maps they are: only the line itself is checked.
    """
    line = track.centerline
    s = np.linspace(0.0, line.length, math.ceil(2.0 * line.length / track.resolution) + 1)
    x, y = line.position(s).T
    bad = np.flatnonzero(track.is_wall(x, y))
    if bad.size == 0:
        return
    first = bad[0]
    col, row = track.world_to_grid(x[first], y[first])
    height, width = track.occupancy.shape
    inside = 0 <= col < width and 0 <= row < height
    what = "passes through a wall" if inside else "leaves the map"
    right = "all of it must be free" if inside else "all of it must lie inside"
    raise OutlapError(
        f"{path}: the centreline {what} at s = {s[first]:.2f} m, x_m = {x[first]:.3f}, y_m = {y[first]:.3f}; {right}"
    )
