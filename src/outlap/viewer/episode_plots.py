"""Figures of recorded episodes and of evaluations: legible in print, and with any colour vision."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from outlap.envs.race import EGO
from outlap.errors import OutlapError
from outlap.evaluation.frame import SLIP, SPEED, YAW
from outlap.evaluation.recording import Recording, check_together
from outlap.evaluation.statistics import estimate_mean
from outlap.figure_style import COLOURS, INK, WIDTH, entitle, finish, new_figure
from outlap.simulator.bicycle import GRAVITY
from outlap.track.track import Track
from outlap.viewer.plots import draw_map, draw_speeds, height_share, plain

PANELS = 6  # of a figure, at most
NEAR_THE_LIMIT = 0.8  # of the grip
LEAST_MOMENTS = 20  # of a task's context, half to learn from and half to tell


def draw_trajectories(
    track: Track, recordings: Sequence[Recording], path: str | os.PathLike[str] | None = None
) -> Figure:
    """Where the ego drove, coloured by its speed: a panel a recording, one scale of colours.

    Args:
        track: that they were raced on.
        recordings: six at most.
        path: where to save the figure as well; the ending says in which format (png, pdf, svg).

    Raises OutlapError for recordings that cannot be shown together, or an ending that Matplotlib cannot write.
    """
    check_together(recordings, track, PANELS)
    columns = 1 if len(recordings) == 1 or height_share(track) < 0.4 else 2
    rows = -(-len(recordings) // columns)
    figure = new_figure(WIDTH, min(9.5, 0.3 + rows * ((WIDTH - 1.2) / columns * height_share(track) + 0.6)))
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    fastest = max(float(recording.motion[:, EGO, SPEED].max()) for recording in recordings)
    coloured = None
    for axes, recording in zip(grid, recordings, strict=False):
        draw_map(axes, track)
        coloured = draw_speeds(axes, recording.path, recording.motion[1:, EGO, SPEED])
        coloured.set_clim(0.0, fastest)
        axes.plot(*recording.path[0], "o", color=INK, markersize=4)
        if recording.info.outcome == "crash":
            axes.plot(*recording.path[-1], "X", color="#C00000", markersize=7)
        outcome = f"{plain(recording.info.title)}: {recording.info.outcome}, {recording.seconds:.1f} s"
        axes.set_title(outcome, loc="left", fontsize=8)
    for axes in grid[len(recordings) :]:
        axes.set_visible(False)
    if coloured is not None:
        figure.colorbar(coloured, ax=grid, label="speed [m/s]", shrink=0.7)
    entitle(figure, f"{plain(track.name)}: where they drove, and how fast")
    return finish(figure, path)


def accelerations(recording: Recording) -> np.ndarray:
    """Along and across the ego's path: (frames - 1, 2) [m/s²], positive forwards and to the left."""
    motion = recording.motion[:, EGO].astype(float)
    step = np.maximum(np.diff(recording.time.astype(float)), 1e-6)
    course = np.unwrap(motion[:, YAW] + motion[:, SLIP])
    speed = 0.5 * (motion[1:, SPEED] + motion[:-1, SPEED])
    return np.column_stack([np.diff(motion[:, SPEED]) / step, speed * np.diff(course) / step])


def draw_friction_circles(recordings: Sequence[Recording], path: str | os.PathLike[str] | None = None) -> Figure:
    """How much of the tyres' grip the ego used: accelerations of every action within the circle of radius μ g.

    Args:
        recordings: six at most, a panel each.
        path: where to save the figure as well.

    Raises OutlapError for too many recordings, or an ending that Matplotlib cannot write.
    """
    if not 1 <= len(recordings) <= PANELS:
        raise OutlapError(f"{len(recordings)} recordings; a figure shows one to {PANELS}")
    columns = min(3, len(recordings))
    rows = -(-len(recordings) // columns)
    width = WIDTH if columns > 1 else 4.0
    figure = new_figure(width, 0.5 + rows * (width / columns + 0.2))
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    reach = 1.25 * max(recording.info.cast.mu for recording in recordings) * GRAVITY
    for axes, recording, colour in zip(grid, recordings, COLOURS, strict=False):
        grip = recording.info.cast.mu * GRAVITY
        along, across = accelerations(recording).T
        used = np.hypot(along, across) / grip
        axes.plot(across, along, ".", color=colour, markersize=2.5, alpha=0.5)
        axes.add_patch(Circle((0.0, 0.0), grip, fill=False, color=INK, linewidth=1.0))
        axes.axhline(0.0, color="#DDDDDD", linewidth=0.6, zorder=0)
        axes.axvline(0.0, color="#DDDDDD", linewidth=0.6, zorder=0)
        near = (used > NEAR_THE_LIMIT).mean()
        axes.set_title(
            f"{plain(recording.info.title)}\nmean {used.mean():.0%} of μ g = {grip:.1f} m/s², "
            f"above {NEAR_THE_LIMIT:.0%} for {near:.0%}",
            loc="left",
            fontsize=7,
        )
        axes.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal")  # what is left is on the left
        axes.set_xlabel("across, left positive [m/s²]", fontsize=7)
    for axes in grid[len(recordings) :]:
        axes.set_visible(False)
    grid[0].set_ylabel("along [m/s²]", fontsize=7)
    entitle(figure, "Use of the friction circle")
    return finish(figure, path)


def draw_lap_time_ratios(rows: pd.DataFrame, path: str | os.PathLike[str] | None = None) -> Figure:
    """Lap times over the least time of the same track and vehicle: episodes as dots, their mean with its interval.

    Args:
        rows: of `evaluate`, of one or several drivers.
        path: where to save the figure as well.

    Raises OutlapError where no episode has a lap, or an ending that Matplotlib cannot write.
    """
    rows = rows.loc[np.isfinite(rows["lap_time_ratio"].to_numpy(np.float64))]
    if not len(rows):
        raise OutlapError("no episode has a completed lap whose time could be compared; race with --laps 1 or more")
    tracks = list(dict.fromkeys(rows["track"].tolist()))
    drivers = list(dict.fromkeys(rows["driver"].tolist()))
    figure = new_figure(WIDTH, 1.0 + 0.28 * len(tracks) * max(len(drivers), 2) ** 0.8)
    axes = figure.subplots()
    rng = np.random.default_rng(0)  # of the dots' heights
    for number, (driver, colour) in enumerate(zip(drivers, COLOURS * 4, strict=False)):
        height = (number + 0.5) / len(drivers) - 0.5
        for row, track in enumerate(tracks):
            mine = rows.loc[(rows["track"] == track) & (rows["driver"] == driver), "lap_time_ratio"].to_numpy(float)
            if not len(mine):
                continue
            middle = row + 0.7 * height
            spread = rng.uniform(-0.3, 0.3, len(mine)) * 0.7 / len(drivers)
            axes.plot(mine, middle + spread, ".", color=colour, markersize=3, alpha=0.3)
            mean = estimate_mean(mine)
            axes.plot(mean.mean, middle, "o", color=colour, markeredgecolor=INK, markersize=5)
            axes.plot([mean.low, mean.high], [middle, middle], color=INK, linewidth=1.4)
        axes.plot([], [], "o", color=colour, markeredgecolor=INK, markersize=5, label=plain(driver))
    axes.axvline(1.0, color=INK, linewidth=0.8)
    axes.set_yticks(range(len(tracks)), [plain(track) for track in tracks])
    axes.invert_yaxis()
    axes.set_xlabel("lap time / least time (1: the minimum-time lap)", fontsize=8)
    if len(drivers) > 1:
        figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    entitle(figure, "Lap times against the fastest possible")
    return finish(figure, path)


def draw_contexts(recordings: Sequence[Recording], path: str | os.PathLike[str] | None = None) -> Figure:
    """Whether a policy's context tells tasks apart: its first two principal components, and how tasks are confused.

    The confusion is that of a linear discriminant (with shrinkage) on the whole context, fitted on the first half of
    each episode and asked about the second.

    Args:
        recordings: of one policy; those with one title on one track are one task.
        path: where to save the figure as well.

    Raises OutlapError for recordings without a context, fewer than two tasks, or more than eight.
    """
    tasks = _tasks(recordings)
    figure = new_figure(WIDTH, 3.4)
    scatter, table = figure.subplots(1, 2)
    everything = np.concatenate([context for contexts in tasks.values() for context in contexts])
    components = PCA(2).fit(everything)
    for (name, contexts), colour, marker in zip(tasks.items(), COLOURS, "os^Dv<>P", strict=False):
        points = components.transform(np.concatenate(contexts))
        scatter.plot(*points.T, marker, color=colour, markersize=2.5, alpha=0.4, label=name, markeredgewidth=0)
    shares = components.explained_variance_ratio_
    scatter.set_xlabel(f"first component ({shares[0]:.0%} of the variance)", fontsize=7)
    scatter.set_ylabel(f"second component ({shares[1]:.0%})", fontsize=7)
    confused = confusion(list(tasks.values()))
    table.imshow(confused, cmap="Greys", vmin=0.0, vmax=1.0)
    for row, values in enumerate(confused):
        for column, value in enumerate(values):
            table.text(
                column, row, f"{value:.0%}", ha="center", va="center", fontsize=7, color="white" if value > 0.5 else INK
            )
    table.set_xticks(range(len(tasks)), list(tasks), rotation=30, ha="right")
    table.set_yticks(range(len(tasks)), list(tasks))
    table.set_xlabel("taken for", fontsize=7)
    table.set_title(
        f"right: {np.trace(confused) / len(tasks):.0%}, by chance {1 / len(tasks):.0%}", loc="left", fontsize=8
    )
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=7, markerscale=3)
    entitle(figure, "What the context tells of the task")
    return finish(figure, path)


def confusion(tasks: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """How often moments of each task are taken for each: (tasks, tasks), rows sum to 1, see `draw_contexts`.

    Args:
        tasks: of each, the contexts (frames, hidden) of its episodes.
    """
    halves: list[tuple[np.ndarray, np.ndarray]] = []
    for contexts in tasks:
        first = np.concatenate([context[: len(context) // 2] for context in contexts])
        second = np.concatenate([context[len(context) // 2 :] for context in contexts])
        halves.append((first, second))
    labels = np.repeat(np.arange(len(tasks)), [len(first) for first, _ in halves])
    model = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto", priors=np.full(len(tasks), 1 / len(tasks)))
    model.fit(np.concatenate([first for first, _ in halves]), labels)
    return np.array([np.bincount(model.predict(second), minlength=len(tasks)) / len(second) for _, second in halves])


def _tasks(recordings: Sequence[Recording]) -> dict[str, list[np.ndarray]]:
    """Contexts by task, under the shortest names that tell tasks apart."""
    without = [recording.info.title for recording in recordings if not recording.context.size]
    if without:
        raise OutlapError(f"{without[0]}: its recording has no context; record a policy of outlap train mql")
    if len({recording.context.shape[1] for recording in recordings}) > 1:
        raise OutlapError("the recordings' contexts are of several sizes; give those of one policy")
    titles = {recording.info.title for recording in recordings}
    tracks = {recording.info.track for recording in recordings}
    found: dict[str, list[np.ndarray]] = {}
    for recording in recordings:
        parts = (recording.info.track if len(tracks) > 1 else "", recording.info.title if len(titles) > 1 else "")
        name = plain(" ".join(filter(None, parts)) or recording.info.track)
        found.setdefault(name, []).append(recording.context)
    short = [name for name, contexts in found.items() if sum(map(len, contexts)) < LEAST_MOMENTS]
    if short:
        raise OutlapError(f"{short[0]}: is over after a few actions; give recordings of {LEAST_MOMENTS} or more")
    if not 2 <= len(found) <= len(COLOURS):
        raise OutlapError(f"recordings of {len(found)} tasks; give those of 2 to {len(COLOURS)} tracks or titles")
    return found
