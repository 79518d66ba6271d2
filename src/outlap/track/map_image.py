"""The map itself: a ROS map_server yaml and the image that it names, with bad ones refused clearly."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from PIL import Image

from outlap.errors import OutlapError, short_repr

MAX_PIXELS = 100_000_000

# What ROS map_server takes where the yaml names none.
_OCCUPIED_THRESHOLD = 0.65
_FREE_THRESHOLD = 0.196


@dataclass(frozen=True, eq=False)
class MapImage:
    """What a map yaml and its image say."""

    occupancy: np.ndarray  # (height, width) bool, True = wall, bottom row first
    resolution: float  # [m/pixel]
    origin: tuple[float, float, float]  # x [m], y [m], yaw [rad] of the lower-left corner


def read_map(path: Path) -> MapImage:
    """Read a ROS map_server yaml and its image. Raises OutlapError, which names the file and the field.

    A pixel is a wall if it is darker (with `negate`: brighter) than `occupied_thresh`; what
    map_server calls unknown is not one. The image must lie in the yaml's folder.
    """
    fields = _read_yaml(path)
    right = "a positive number of metres per pixel"
    resolution = _number(path, "resolution", fields["resolution"], right, lambda value: value > 0.0)
    return MapImage(_read_occupancy(path, fields), resolution, _origin(path, fields))


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file; raise OutlapError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise OutlapError(f"{path}: does not exist") from None
    except UnicodeDecodeError:
        raise OutlapError(f"{path}: is not a text file; it must be UTF-8") from None
    except OSError as error:
        raise OutlapError(f"{path}: cannot be read: {error.strerror}") from None


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        fields = yaml.safe_load(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, OutlapError):
            raise
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or type(error).__name__
        raise OutlapError(f"{path}: is not valid yaml{where}: {' '.join(str(problem).split())}") from None
    if not isinstance(fields, Mapping):
        raise OutlapError(f"{path}: holds {short_repr(fields)}; it must be a mapping with image, resolution and origin")
    fields = cast("Mapping[str, Any]", fields)
    for field in ("image", "resolution", "origin"):
        if fields.get(field) is None:
            raise OutlapError(f"{path}: {field} is missing; a map needs image, resolution and origin")
    return fields


def _read_occupancy(path: Path, fields: Mapping[str, Any]) -> np.ndarray:
    """The map image as (height, width) bool, True = wall, bottom row first."""
    mode = fields.get("mode", "trinary")
    if mode not in ("trinary", "scale"):
        raise OutlapError(f"{path}: mode is {short_repr(mode)}; it must be trinary or scale")
    negate = fields.get("negate", 0)
    if negate not in (0, 1):  # True and False are these too
        raise OutlapError(f"{path}: negate is {short_repr(negate)}; it must be 0 or 1")
    occupied = _threshold(path, fields, "occupied_thresh", _OCCUPIED_THRESHOLD)
    free = _threshold(path, fields, "free_thresh", min(_FREE_THRESHOLD, occupied))
    if free > occupied:
        raise OutlapError(f"{path}: free_thresh is {free}; it must not be above occupied_thresh, {occupied}")
    sums, highest = _channel_sums(_image_path(path, fields["image"]), average_alpha=mode == "trinary")
    # The sums are whole numbers: how many of the darkest (brightest) are walls is found exactly as
    # map_server decides, and the picture compared with that.
    wall_sums = int(np.count_nonzero(np.arange(highest + 1) / highest > occupied))
    return sums[::-1] > highest - wall_sums if negate else sums[::-1] < wall_sums


def _image_path(yaml_path: Path, image: object) -> Path:
    wrong = f"{yaml_path}: image is {short_repr(image)}"
    if not isinstance(image, str) or not image.strip():
        raise OutlapError(f"{wrong}; it must be the name of a file in the folder")
    folder = yaml_path.parent.resolve()
    try:
        path = (folder / image).resolve()
        inside = not Path(image).is_absolute() and path.is_relative_to(folder)
        is_file = inside and path.is_file()
    except (OSError, ValueError, RuntimeError):
        raise OutlapError(f"{wrong}; it must be the name of a file in the folder") from None
    if not inside:
        raise OutlapError(f"{wrong}; it must not lead out of the folder")
    if not is_file:
        raise OutlapError(f"{wrong}; there is no such file in the folder")
    return path


def _channel_sums(path: Path, average_alpha: bool) -> tuple[np.ndarray, int]:
    """The sum of each pixel's channels (height, width), and the highest sum there can be.

    As in ROS map_server, an alpha channel is averaged with the colours in trinary mode.
    """
    most = f"it must have at most {MAX_PIXELS // 1_000_000} million"
    try:
        # Pillow warns of, then refuses, big pictures at sizes of its own.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            opened = Image.open(path)
        with opened as image:
            if image.width * image.height > MAX_PIXELS:
                raise OutlapError(f"{path}: has {image.width} x {image.height} pixels; {most}")
            return _sum_channels(path, image, average_alpha)
    except Image.DecompressionBombError:
        raise OutlapError(f"{path}: has too many pixels; {most}") from None
    except OutlapError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, TypeError, OverflowError) as error:
        problem = " ".join(str(error).split()) if not isinstance(error, Image.UnidentifiedImageError) else ""
        reason = f" ({problem})" if problem else ""
        raise OutlapError(f"{path}: is not a readable image{reason}; it must be a png or pgm") from None


def _sum_channels(path: Path, image: Image.Image, average_alpha: bool) -> tuple[np.ndarray, int]:
    mode = image.mode
    if mode == "L" and "transparency" not in image.info:
        return np.asarray(image), 255
    if mode == "1":
        return np.asarray(image.convert("L")), 255
    if mode.startswith("I"):  # 16 bit: Pillow scales a pgm's own maximum to 65535
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            raise OutlapError(f"{path}: has {values.max()} as a pixel; it must have 8 or 16 bits a channel")
        return values.astype(np.uint16), 65535
    if mode == "F":
        raise OutlapError(f"{path}: has floating-point pixels; it must have 8 or 16 bits a channel")
    has_alpha = mode in ("LA", "PA", "RGBA", "La", "RGBa") or "transparency" in image.info
    channels = np.asarray(image.convert("RGBA" if has_alpha and average_alpha else "RGB"))
    return channels.sum(axis=2, dtype=np.uint16), 255 * channels.shape[2]


def _origin(path: Path, fields: Mapping[str, Any]) -> tuple[float, float, float]:
    origin = fields["origin"]
    right = "it must be [x, y, yaw] in metres and radians"
    values = cast("list[object]", origin) if isinstance(fields["origin"], list) else []
    if len(values) != 3:
        raise OutlapError(f"{path}: origin is {short_repr(origin)}; {right}")
    x, y, yaw = map(_to_float, values)
    if x is None or y is None or yaw is None:
        raise OutlapError(f"{path}: origin is {short_repr(origin)}; {right}, all finite")
    return x, y, yaw


def _number(path: Path, field: str, value: object, right: str, valid: Callable[[float], bool]) -> float:
    number = _to_float(value)
    if number is None or not valid(number):
        raise OutlapError(f"{path}: {field} is {short_repr(value)}; it must be {right}")
    return number


def _threshold(path: Path, fields: Mapping[str, Any], field: str, default: float) -> float:
    value = default if fields.get(field) is None else fields[field]
    return _number(path, field, value, "a number from 0 to 1", lambda share: 0.0 <= share <= 1.0)


def _to_float(value: object) -> float | None:
    """Return `value` as a finite float, or None. Text counts, because yaml reads 1e-2 as text."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None
