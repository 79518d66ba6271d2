"""A map of where cars crash, with the hot spots labelled."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.figure_style import BLUE, INK, VERMILION, WIDTH, entitle, finish, new_figure
from outlap.track.track import Track
from outlap.viewer.plots import draw_map, height_share, plain

PANELS = 12  # of a figure, at most
COLUMNS = 3
ZONE = 2.5  # [m] radius of the ring about a hot spot: half of the window that finds it


def draw_crashes(
    tracks: Sequence[Track],
    rows: pd.DataFrame,
    spots: Sequence[Mapping[str, Any]],
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw crashes as dots on the tracks, hot spots as rings with their place, number and share of the track's crashes.

    Tracks with most crashes come first; those without a crash are left out, and those beyond twelve.

    Args:
        tracks: that were raced on.
        rows: of `evaluate`; of several drivers for all their crashes together.
        spots: of `hot_spots`.
        path: where to save the figure as well; the ending says in which format (png, pdf, svg).

    Raises OutlapError where nobody crashed, and for an ending that Matplotlib cannot write.
    """
    crashes = rows.loc[rows["outcome"] == CRASH]
    counts, races = (Counter(each["track"].tolist()) for each in (crashes, rows))
    chosen = sorted((track for track in tracks if counts[track.name]), key=lambda track: -counts[track.name])
    left_out = len(chosen) - PANELS
    chosen = chosen[:PANELS]
    if not chosen:
        raise OutlapError("no episode ended in a crash: there is nothing to draw")
    columns = min(COLUMNS, len(chosen)) if len(chosen) > 4 else min(2, len(chosen))
    lines = -(-len(chosen) // columns)
    width = (WIDTH - 0.2) / columns
    tallest = [max(map(height_share, chosen[i : i + columns])) for i in range(0, len(chosen), columns)]
    heights = [min(1.6 * width, 6.5, width * share) + 0.35 for share in tallest]
    figure = new_figure(WIDTH, sum(heights) + 0.8)
    grid = figure.subplots(lines, columns, squeeze=False, height_ratios=heights).ravel()
    for axes, track in zip(grid, chosen, strict=False):
        here = crashes.loc[crashes["track"] == track.name]
        _draw_panel(axes, track, here, [spot for spot in spots if spot["track"] == track.name], width)
        axes.set_title(f"{plain(track.name)}: {len(here)} of {races[track.name]} crashed", loc="left", fontsize=8)
    for axes in grid[len(chosen) :]:
        axes.set_visible(False)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    title = f"{plain(', '.join(dict.fromkeys(rows['driver'].tolist())))}: where cars crashed"
    entitle(figure, title + (f" (the {PANELS} tracks with most; {left_out} more have crashes)" if left_out > 0 else ""))
    return finish(figure, path)


def _draw_panel(
    axes: Axes, track: Track, crashes: pd.DataFrame, spots: Sequence[Mapping[str, Any]], inches: float
) -> None:
    draw_map(axes, track)
    axes.set(xticks=[], yticks=[], anchor="NW")
    axes.spines[["left", "bottom"]].set_visible(False)
    line = track.centerline
    axes.plot(*line.position(np.linspace(0.0, line.length, round(4 * line.length))).T, color=BLUE, linewidth=0.5)
    right, left = line.widths(0.0)
    axes.plot(*line.to_cartesian(np.zeros(2), [-float(right), float(left)]).T, color=INK, linewidth=1.6)
    where = line.to_cartesian(crashes["crash_s_m"].to_numpy(), crashes["crash_d_m"].to_numpy())
    large = inches > 0.5 * WIDTH
    size = 14 if large else 7
    axes.scatter(*where.T, s=size, color=VERMILION, alpha=0.55, linewidths=0.0, zorder=3)
    for spot in spots:
        _draw_spot(axes, track, spot, 9.0 if large else 7.0, inches)


def _draw_spot(axes: Axes, track: Track, spot: Mapping[str, Any], font: float, inches: float) -> None:
    x, y = track.centerline.position(spot["s_m"])
    across = float(np.ptp(axes.get_xlim()))
    axes.add_patch(Circle((x, y), max(ZONE, 0.02 * across), fill=False, color=INK, linewidth=1.0, zorder=4))
    text = f"{spot['s_m']:.0f} m: {spot['crashes']} ({100 * spot['share']:.0f} %)"
    metres = across / (72.0 * inches)  # for each point on paper
    place = _free_place(axes, track, np.array((x, y)), np.array((0.62 * len(text) + 1.0, 1.8)) * font * metres, metres)
    axes.annotate(
        text,
        (x, y),
        xytext=tuple(place),
        ha="center",
        va="center",
        fontsize=font,
        fontweight="bold",
        color=INK,
        zorder=5,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
        arrowprops={"arrowstyle": "-", "color": INK, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 7},
    )


def _free_place(axes: Axes, track: Track, at: np.ndarray, size: np.ndarray, metres: float) -> np.ndarray:
    """Return the centre [m] of a label of a size (2,) [m] that covers as little of the track as possible.

    Sixteen directions at three distances are tried; `metres` is the length of a point on paper.
    """
    line = track.centerline
    band = line.position(np.arange(0.0, line.length, 0.5))
    low, high = np.array((axes.get_xlim(), axes.get_ylim())).T
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    places = np.concatenate([at + around * (0.5 * size + gap * metres) for gap in (12.0, 22.0, 40.0)])
    half = 0.5 * size + 1.2  # and about half of the track's width
    covered = (np.abs(band - places[:, None]) < half).all(axis=2).sum(axis=1)
    outside = np.maximum(low - places + 0.5 * size, 0.0) + np.maximum(places + 0.5 * size - high, 0.0)
    return places[np.argmin(covered + 1e3 * outside.sum(axis=1))]


def _legend() -> list[Line2D]:
    return [
        Line2D([], [], color=VERMILION, marker="o", markersize=4, linewidth=0, alpha=0.7, label="crash"),
        Line2D(
            [], [], color=INK, marker="o", markersize=8, fillstyle="none", linewidth=0,
            label="hot spot: metres from the start line, crashes (share of the track's)",
        ),
        Line2D([], [], color=INK, linewidth=1.6, label="start line"),
    ]  # fmt: skip
