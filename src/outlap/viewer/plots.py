"""Figures for reports and papers: made without a display and without Matplotlib's global state."""

from __future__ import annotations

import math
import os

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D, offset_copy

from outlap.figure_style import BLUE, INK, VERMILION, WALL_GREY, WIDTH, finish, new_figure
from outlap.track.raceline import Raceline
from outlap.track.track import Track

RACELINE_DASHES = (0, (4, 1.5))

MAX_MAP_PIXELS = 1600  # of the longer side of the drawn map


def draw_track(track: Track, path: str | os.PathLike[str] | None = None) -> Figure:
    """Map and curvature of a track: walls, centreline, start line, direction, racing line if there is one.

    Both panels mark the same distances along the centreline, so that a corner of the map can be found
    in the plot below it.

    Args:
        track: to draw; the map is in metres in the map frame.
        path: where to save the figure as well; the ending says in which format (png, pdf, svg).

    Raises:
        OutlapError: the ending of `path` names no format that Matplotlib writes.
    """
    centerline = track.centerline
    map_height = min(8.0, max(2.5, (WIDTH - 0.8) * height_share(track)))
    figure = new_figure(WIDTH, map_height + 2.6)
    map_axes, curvature_axes = figure.subplots(2, 1, height_ratios=(map_height, 1.5))
    marks = np.arange(0.0, centerline.length, _mark_spacing(centerline.length))

    title = f"{plain(track.name)}: {centerline.length:.0f} m, {_direction(track)}"
    map_axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
    draw_map(map_axes, track)
    _draw_line(map_axes, track)
    _draw_marks(map_axes, track, marks)
    _draw_start(figure, map_axes, track)
    map_axes.set(xlabel="x [m]", ylabel="y [m]")
    figure.legend(handles=_legend(track), loc="outside lower center", ncols=4, frameon=False, fontsize=8)

    _draw_curvature(curvature_axes, track, marks)
    return finish(figure, path)


def draw_raceline(
    track: Track, line: Raceline, path: str | os.PathLike[str] | None = None, lap_time: float | None = None
) -> Figure:
    """A racing line coloured by speed on the map, and its speed and accelerations along it.

    Args:
        track: whose map is drawn.
        line: to draw.
        path: where to save the figure as well; the ending says in which format (png, pdf, svg).
        lap_time: for the title [s].
    """
    map_height = min(8.0, max(2.5, (WIDTH - 1.4) * height_share(track)))
    figure = new_figure(WIDTH, map_height + 3.2)
    map_axes, speed_axes, grip_axes = figure.subplots(3, 1, height_ratios=(map_height, 1.2, 1.2))
    length = float(line.s[-1] + np.hypot(line.x[0] - line.x[-1], line.y[0] - line.y[-1]))
    lap = "" if lap_time is None else f", lap {lap_time:.2f} s"
    map_axes.set_title(f"{plain(track.name)}: {length:.0f} m{lap}", loc="left", fontsize=11, fontweight="bold")
    draw_map(map_axes, track)
    points = np.column_stack([line.x, line.y])
    coloured = draw_speeds(map_axes, np.vstack([points, points[:1]]), line.speed)
    figure.colorbar(coloured, ax=map_axes, label="speed [m/s]", shrink=0.8)
    _draw_start(figure, map_axes, track)
    map_axes.set(xlabel="x [m]", ylabel="y [m]")
    speed_axes.plot(line.s, line.speed, color=BLUE, linewidth=1.0)
    speed_axes.set(ylabel="speed [m/s]", xlim=(0.0, length), ylim=(0.0, 1.05 * float(line.speed.max())))
    grip_axes.plot(line.s, line.acceleration, color=BLUE, linewidth=0.9, label="along")
    across = line.speed**2 * line.curvature
    grip_axes.plot(line.s, across, color=VERMILION, linewidth=0.9, linestyle=RACELINE_DASHES, label="across")
    grip_axes.axhline(0.0, color=INK, linewidth=0.6)
    grip_axes.set(xlabel="distance along the line [m]", ylabel="acceleration\n[m/s²]", xlim=(0.0, length))
    grip_axes.legend(loc="upper right", ncols=2, fontsize=7, frameon=False)
    return finish(figure, path)


def plain(name: str) -> str:
    """A name as Matplotlib shows it and nothing else: a $ begins no formula."""
    return name.replace("$", r"\$")


def height_share(track: Track) -> float:
    """Return the height of a track's map, as drawn, divided by its width."""
    width, height = np.subtract(*_view(track)[::-1])
    return float(height / width)


def _view(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of what is shown [m]: the track, not the empty rest of its map."""
    points = track.centerline.points
    half_width = max(track.centerline.width_left.max(), track.centerline.width_right.max())
    border = half_width + 0.06 * np.ptp(points, axis=0).max()  # room for the marks
    return points.min(axis=0) - border, points.max(axis=0) + border


def _mark_spacing(length: float) -> float:
    """A round distance [m] that divides the lap into five to twelve."""
    power = 10.0 ** math.floor(math.log10(length / 5))
    return max(power * factor for factor in (1, 2, 5) if power * factor <= length / 5)


def _direction(track: Track) -> str:
    x, y = track.centerline.points.T
    return "anticlockwise" if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0 else "clockwise"


def draw_map(axes: Axes, track: Track) -> None:
    """Draw the walls of a track, on axes in metres that show all of it."""
    block = -(-max(track.occupancy.shape) // MAX_MAP_PIXELS)
    coarse = track.coarse(block)
    rows, cols = coarse.shape
    image = np.zeros((rows, cols, 4), dtype=np.uint8)
    image[coarse] = (*bytes.fromhex(WALL_GREY[1:]), 255)
    size = block * track.resolution
    x, y, yaw = track.origin
    axes.imshow(
        image,
        origin="lower",
        extent=(0, cols * size, 0, rows * size),
        transform=Affine2D().rotate(yaw).translate(x, y) + axes.transData,
        interpolation="none",
    )
    (left, bottom), (right, top) = _view(track)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")


def draw_speeds(axes: Axes, points: np.ndarray, speed: np.ndarray) -> LineCollection:
    """Draw a path of points (n, 2) [m] whose n - 1 pieces are coloured by speed [m/s]."""
    coloured = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis", capstyle="round")
    coloured.set(array=speed, linewidth=1.6)
    axes.add_collection(coloured)
    return coloured


def _draw_line(axes: Axes, track: Track) -> None:
    s = np.linspace(0.0, track.centerline.length, max(400, round(4 * track.centerline.length)))
    axes.plot(*track.centerline.position(s).T, color=BLUE, linewidth=1.0)
    if track.raceline is not None:
        x, y = track.raceline.x, track.raceline.y
        axes.plot(np.append(x, x[0]), np.append(y, y[0]), color=VERMILION, linewidth=1.0, linestyle=RACELINE_DASHES)


def _draw_marks(axes: Axes, track: Track, marks: np.ndarray) -> None:
    axes.plot(*track.centerline.position(marks[1:]).T, "o", color=BLUE, markersize=3)
    for s in marks[1:]:
        x, y = track.centerline.position(s)
        axes.annotate(
            f"{s:g}",
            (x, y),
            xytext=_outwards(track, s),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=7,
            color=INK,
            bbox={"boxstyle": "round,pad=0.12", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )


def _outwards(track: Track, s: float) -> tuple[float, float]:
    """Where a label at `s` goes, [points]: to the outside of the lap, off the line."""
    heading = float(track.centerline.heading(s))
    side = 1.0 if _direction(track) == "clockwise" else -1.0
    return -13.0 * side * math.sin(heading), 13.0 * side * math.cos(heading)


def _draw_start(figure: Figure, axes: Axes, track: Track) -> None:
    right, left = track.centerline.widths(0.0)
    ends = track.centerline.to_cartesian(np.zeros(2), np.array((-float(right), float(left))))
    axes.plot(*ends.T, color=INK, linewidth=2.5, solid_capstyle="butt")
    # The arrow is beside the line and of a fixed size on paper: legible however long the lap is.
    heading = float(track.centerline.heading(0.0))
    along, beside = np.array((math.cos(heading), math.sin(heading))), np.array(_outwards(track, 0.0))
    start = tuple(track.centerline.position(0.0))
    tail, head = beside - 12 * along, beside + 16 * along
    axes.annotate(
        "",
        xy=start,
        xycoords=offset_copy(axes.transData, figure, *head, units="points"),
        xytext=start,
        textcoords=offset_copy(axes.transData, figure, *tail, units="points"),
        arrowprops={"arrowstyle": "-|>", "linewidth": 1.8, "color": INK, "shrinkA": 0, "shrinkB": 0},
    )


def _legend(track: Track) -> list[Artist]:
    entries: list[Artist] = [
        Line2D([], [], color=BLUE, marker="o", markersize=3, linewidth=1, label="centreline, metres from the start"),
        Line2D([], [], color=INK, linewidth=2.5, label="start line, direction"),
        Patch(facecolor=WALL_GREY, label="wall"),
    ]
    if track.raceline is not None:
        entries.append(Line2D([], [], color=VERMILION, linewidth=1, linestyle=RACELINE_DASHES, label="racing line"))
    return entries


def _draw_curvature(axes: Axes, track: Track, marks: np.ndarray) -> None:
    length = track.centerline.length
    s = np.linspace(0.0, length, max(1000, round(10 * length)))
    curvature = track.centerline.curvature(s)
    axes.fill_between(s, curvature, color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(s, curvature, color=BLUE, linewidth=0.9)
    axes.axhline(0.0, color=INK, linewidth=0.6)
    reach = 1.15 * max(float(np.max(np.abs(curvature))), 0.05)
    axes.set(
        xlim=(0.0, length),
        ylim=(-reach, reach),
        xlabel="distance along the centreline [m]",
        ylabel="curvature [1/m]",
        xticks=marks,
    )
    axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    beside = {"ha": "right", "fontsize": 8, "color": INK, "transform": axes.transAxes}
    axes.text(0.995, 0.97, "left", va="top", **beside)
    axes.text(0.995, 0.03, "right", va="bottom", **beside)
