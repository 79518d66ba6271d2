"""The figures of a report."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from outlap.errors import OutlapError
from outlap.evaluation.statistics import Estimate, estimate_mean, performance_profile
from outlap.experiments.results import METRICS, Cell, TableResult
from outlap.figure_style import COLOURS, INK, WIDTH, entitle, finish, new_figure
from outlap.training.run import load_run

RULES = {"none": "no clip", "fixed": "fixed clip", "abc": "ABC", "uniform": "β = 1"}
RULE_COLOURS = {"none": COLOURS[4], "fixed": COLOURS[0], "abc": COLOURS[1], "uniform": COLOURS[7]}
POINTS = 60  # of a learning curve


def draw_intervals(
    cells: Mapping[str, Mapping[str, Estimate]] | Mapping[str, Mapping[str, Cell]],
    metrics: Sequence[str],
    titles: Mapping[str, str] | None = None,
    title: str = "",
) -> Figure:
    """Numbers of every method as points with their intervals, what the paper has beside them as crosses.

    Args:
        cells: by method and metric.
        metrics: a panel each.
        titles: of methods; by default their names.
        title: of the figure.
    """
    figure = new_figure(WIDTH, 0.9 + 0.34 * len(cells))
    panels = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
    heights = range(len(cells) - 1, -1, -1)
    published = False
    for axes, metric in zip(panels, metrics, strict=True):
        for height, (row, colour) in zip(heights, zip(cells.values(), cycle(COLOURS), strict=False), strict=True):
            cell = row[metric]
            axes.plot([cell.low, cell.high], [height, height], color=colour, linewidth=1.6, solid_capstyle="butt")
            axes.plot(cell.mean, height, "o", color=colour, markersize=5)
            paper = getattr(cell, "published", None)
            if isinstance(paper, (int, float)):
                axes.plot(paper, height, "x", color=INK, markersize=6)
                published = True
        axes.set_xlabel(METRICS[metric].heading, fontsize=8)
    panels[0].set_yticks(heights, [(titles or {}).get(method, method) for method in cells], fontsize=8)
    if published:
        mark = Line2D([], [], color=INK, marker="x", linestyle="none", markersize=6, label="the paper")
        figure.legend(handles=[mark], loc="outside lower center", frameon=False, fontsize=7)
    if title:
        entitle(figure, title)
    return finish(figure)


def draw_profiles(results: Sequence[TableResult], titles: Mapping[str, str], title: str) -> Figure:
    """The share of seeds and tasks that come further than a share of what top speed would give."""
    columns = min(3, len(results))
    rows = -(-len(results) // columns)
    figure = new_figure(WIDTH, 0.8 + 2.2 * rows)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    thresholds = np.linspace(0.0, 1.0, 201)
    for axes, result in zip(grid.ravel(), results, strict=False):
        for (method, scores), colour in zip(result.scores.items(), cycle(COLOURS), strict=False):
            axes.plot(
                thresholds, performance_profile(scores, thresholds), color=colour, linewidth=1.2, label=titles[method]
            )
        axes.set_title(result.plan.name, loc="left", fontsize=9)
        axes.set_xlabel("τ: progress over top speed × time", fontsize=7)
    for axes in grid.ravel()[len(results) :]:
        axes.set_visible(False)
    grid[0, 0].set_ylabel("share above τ", fontsize=8)
    _legend_below(figure, grid[0, 0], 3)
    entitle(figure, title)
    return finish(figure)


def draw_learning(curves: Mapping[str, Sequence[pd.DataFrame]], title: str) -> Figure:
    """Return and crash rate of trainings over their steps: mean over seeds, with Student's 95 % interval.

    Args:
        curves: of every label, one table a seed with `step`, `episode_return` and `crash_rate`.
        title: of the figure.
    """
    figure = new_figure(WIDTH, 2.7)
    returns, crashes = figure.subplots(1, 2)
    for (label, seeds), colour in zip(curves.items(), cycle(COLOURS), strict=False):
        seeds = [seed for seed in seeds if len(seed)]
        if not seeds:
            continue
        steps = np.linspace(0.0, min(seed["step"].to_numpy()[-1] for seed in seeds), POINTS)
        for axes, name in ((returns, "episode_return"), (crashes, "crash_rate")):
            each = np.array([np.interp(steps, seed["step"].to_numpy(), seed[name].to_numpy()) for seed in seeds])
            axes.plot(steps / 1e6, each.mean(axis=0), color=colour, linewidth=1.2, label=label)
            if len(each) > 1:
                bands = [estimate_mean(values) for values in each.T]
                low, high = [band.low for band in bands], [band.high for band in bands]
                axes.fill_between(steps / 1e6, low, high, color=colour, alpha=0.2, linewidth=0)
    returns.set_ylabel("return of recent episodes", fontsize=8)
    crashes.set(ylim=(0.0, 1.0))
    crashes.set_ylabel("share of them that crash", fontsize=8)
    for axes in (returns, crashes):
        axes.set_xlabel("actions [million]", fontsize=8)
    if len(curves) > 1:
        _legend_below(figure, returns, 6)
    entitle(figure, title)
    return finish(figure)


def draw_figure_2(updates: pd.DataFrame, gradients: pd.DataFrame, title: str) -> Figure:
    """The paper's figure 2, and what remains of it once weights are made comparable.

    Args:
        updates: of `clipping.compare_rules`, with `adaptation_seed`.
        gradients: likewise.
    """
    figure = new_figure(WIDTH, 5.0)
    grid = figure.subplots(2, 3)
    panels = (
        ("critic_loss", "weighted critic loss", True),
        ("critic_loss_variance", "its variance over the batch", True),
        ("effective_sample_size", "effective sample size", False),
        ("td_error", "TD error of the replay, β = 1", False),
        ("clipped_share", "share of weights clipped", False),
    )
    for axes, (name, label, log) in zip(grid.ravel(), panels, strict=False):
        for rule, mine in updates.groupby("rule", sort=False):
            by_seed = mine.pivot_table(index="adaptation_seed", columns="update", values=name).to_numpy(np.float64)
            middle = np.median(by_seed, axis=0)
            axes.plot(middle, color=RULE_COLOURS[str(rule)], linewidth=1.0, label=RULES[str(rule)])
            if len(by_seed) > 1:
                low, high = np.quantile(by_seed, [0.25, 0.75], axis=0)
                axes.fill_between(
                    np.arange(len(middle)), low, high, color=RULE_COLOURS[str(rule)], alpha=0.18, linewidth=0
                )
        if log:
            axes.set_yscale("log")
        axes.set_title(label, loc="left", fontsize=8)
        axes.set_xlabel("replay update", fontsize=7)
    axes = grid[1, 2]
    variances = gradients.pivot_table(index="adaptation_seed", columns="rule", values="gradient_variance")
    for place, rule in enumerate(RULES):
        ratio = variances[rule].to_numpy() / variances["uniform"].to_numpy()
        spread = place + np.linspace(-0.15, 0.15, len(ratio))
        axes.plot(spread, ratio, ".", color=RULE_COLOURS[rule])
        axes.plot(place, float(np.median(ratio)), "_", color=INK, markersize=14)
    axes.set_yscale("log")
    axes.set_xticks(range(len(RULES)), list(RULES.values()), fontsize=7)
    axes.set_title("gradient variance (mean β 1),\nover that of β = 1", loc="left", fontsize=8)
    _legend_below(figure, grid[0, 0], 3)
    entitle(figure, title)
    return finish(figure)


def draw_weights(histograms: pd.DataFrame, updates: pd.DataFrame, title: str) -> Figure:
    """β before and after ABC during adaptations: how they are distributed, and their largest over the updates."""
    figure = new_figure(WIDTH, 2.9)
    spread, largest = figure.subplots(1, 2)
    mine = histograms.loc[histograms["rule"] == "abc"].groupby("log10_beta")[["before", "after"]].sum()
    edges = mine.index.to_numpy(np.float64)
    width = float(edges[1] - edges[0])
    for name, label, colour in (("before", "β", COLOURS[7]), ("after", "β clipped by ABC", COLOURS[1])):
        counts = mine[name].to_numpy(np.float64)
        spread.step(edges + width, np.maximum(counts, 0.5), where="pre", color=colour, linewidth=1.2, label=label)
    used = np.flatnonzero(mine["before"].to_numpy() > 0)
    spread.set(yscale="log", xlim=(edges[used[0]] - width, edges[used[-1]] + 2 * width))
    spread.set_xlabel("log10 β", fontsize=8)
    spread.set_ylabel("transitions", fontsize=8)
    spread.legend(fontsize=7, frameon=False)
    abc = updates.loc[updates["rule"] == "abc"]
    for name, label, colour in (
        ("beta_max", "largest β of a batch", COLOURS[7]),
        ("clipped_beta_max", "after ABC", COLOURS[1]),
        ("clip_level", "ABC's level", INK),
    ):
        by_seed = abc.pivot_table(index="adaptation_seed", columns="update", values=name).to_numpy(np.float64)
        largest.plot(np.median(by_seed, axis=0), color=colour, linewidth=1.0, label=label)
    largest.set(yscale="log")
    largest.set_xlabel("replay update (median over adaptations)", fontsize=8)
    largest.legend(fontsize=7, frameon=False)
    entitle(figure, title)
    return finish(figure)


def _legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """Draw the legend of one panel below all of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=7)


def read_learning(folder: Path) -> pd.DataFrame:
    """A run's learning curve from its TensorBoard log: `step`, `episode_return`, `crash_rate`; empty without one."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    names = {"episode_return": "race/episode_return", "crash_rate": "race/crash_rate"}
    # Of a run that was stopped it would tell that what comes again is passed over.
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    log = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    log.Reload()
    if not set(names.values()) <= set(log.Tags()["scalars"]):
        return pd.DataFrame(columns=["step", *names])
    columns = {name: {event.step: event.value for event in log.Scalars(tag)} for name, tag in names.items()}
    return pd.DataFrame(columns).rename_axis("step").sort_index().reset_index()


def learning_curves(names: Sequence[str]) -> dict[str, list[pd.DataFrame]]:
    """Return the learning curves of runs by method; a method is called by its first run.

    Raises OutlapError for a name that is no run folder, and for a run without a curve.
    """
    runs = [load_run(name) for name in names]
    short = [run.folder.resolve().name for run in runs]
    titles = short if len(set(short)) == len(short) else [str(run.folder) for run in runs]
    methods: dict[str, list[tuple[str, pd.DataFrame]]] = {}
    for title, run in zip(titles, runs, strict=True):
        curve = read_learning(run.folder)
        if not len(curve):
            raise OutlapError(f"{run.folder}: has no learning curve yet; train longer, or leave it out")
        methods.setdefault(run.method, []).append((title, curve))
    return {
        members[0][0] + (f" ({len(members)} seeds)" if len(members) > 1 else ""): [curve for _, curve in members]
        for members in methods.values()
    }
