"""From episode rows to the numbers of a report; the seed of a training is the unit of every interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from outlap.config import bounds
from outlap.envs.terminations import CRASH
from outlap.evaluation.results import ROWS
from outlap.evaluation.statistics import (
    estimate_mean,
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
    probability_of_improvement_interval,
    stratified_bootstrap,
)
from outlap.experiments.definitions import Method, Published
from outlap.experiments.plan import Plan, TablePlan

PAPER_EPISODES = 500  # that counts are given for
PAPER_STEP = 0.01  # [s] that episode lengths are counted in


@dataclass(frozen=True)
class Metric:
    """A number of an episode, and how it is told."""

    heading: str
    of_rows: Callable[[pd.DataFrame], np.ndarray]  # one number an episode
    better: int  # 1: more is better, -1: less is, 0: methods are not compared in it
    digits: int
    per_paper_episodes: bool = False  # a count in 500 episodes, and not a mean
    most: float = math.inf  # that a count can be
    published: Callable[[Published], float | tuple[float, float] | None] = lambda _: None

    def values(self, rows: pd.DataFrame) -> np.ndarray:
        """Of every episode, such that their mean is the metric."""
        factor = PAPER_EPISODES if self.per_paper_episodes else 1
        return factor * np.asarray(self.of_rows(rows), np.float64)


METRICS: dict[str, Metric] = {
    "overtakes": Metric(
        "overtakes in 500", lambda rows: rows["overtakes"].to_numpy(), 1, 0, True,
        published=lambda paper: paper.overtakes,
    ),
    "crashes": Metric(
        "crashes in 500", lambda rows: (rows["outcome"] == CRASH).to_numpy(), -1, 0, True, PAPER_EPISODES,
        published=lambda paper: paper.crashes,
    ),
    "episode_length": Metric(
        "length [0.01 s]", lambda rows: rows["duration_s"].to_numpy() / PAPER_STEP, 0, 0,
        published=lambda paper: paper.episode_length,
    ),
    "reward": Metric(
        "reward of the last step", lambda rows: rows["last_reward"].to_numpy(), 0, 3,
        published=lambda paper: paper.reward,
    ),
    "return": Metric("return", lambda rows: rows["episode_return"].to_numpy(), 0, 1),
    "progress_m": Metric("progress [m]", lambda rows: rows["progress_m"].to_numpy(), 1, 1),
    "mean_speed_mps": Metric("speed [m/s]", lambda rows: rows["mean_speed_mps"].to_numpy(), 0, 2),
    "places_lost": Metric("places lost in 500", lambda rows: rows["places_lost"].to_numpy(), 0, 0, True),
}  # fmt: skip
RACING = ("overtakes", "places_lost")  # metrics of races with other cars only


@dataclass(frozen=True)
class Cell:
    """A metric of a method: over seeds, with what the paper reports."""

    mean: float  # over seeds
    low: float  # ends of Student's t interval of that mean
    high: float
    sd: float  # over episodes of all seeds, as the paper has it
    seeds: int
    iqm: float  # interquartile mean over seeds and tasks
    iqm_low: float  # ends of its stratified bootstrap interval
    iqm_high: float
    published: float | tuple[float, float] | None


@dataclass(frozen=True)
class Comparison:
    """A method against another, in one metric, paired by seed and task."""

    metric: str
    method: str
    other: str
    difference: float  # method minus other
    low: float
    high: float
    probability: float  # that a training of `method` is the better one
    probability_low: float
    probability_high: float
    claim: str  # what is shown: better, worse, or not shown


@dataclass(frozen=True)
class TableResult:
    """A table with its numbers."""

    plan: TablePlan
    title: str
    metrics: tuple[str, ...]
    cells: dict[str, dict[str, Cell]]  # by method and metric
    comparisons: tuple[Comparison, ...]
    scores: dict[str, np.ndarray]  # by method (seeds, tasks): progress over that at top speed


def read_rows(plan: Plan, work: Path) -> pd.DataFrame:
    """The rows of every race of a plan, each once."""
    races = [race for table in plan.tables for race in table.races]
    rows = [pd.read_parquet(race.folder(work) / ROWS) for race in races]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def table_result(plan: Plan, table: TablePlan, rows: pd.DataFrame) -> TableResult:
    """The numbers of a table from the rows of its races."""
    of_method = {
        method: rows.loc[(rows["table"] == table.name) & (rows["method"] == method)] for method in plan.methods
    }
    definition = plan.task_sets[table.task_set].tables[table.name]
    alone = table.races[0].env.num_cars == 1
    metrics = tuple(name for name in METRICS if not (alone and name in RACING))
    scores = {
        metric: {method: seed_scores(of_method[method], METRICS[metric]) for method in plan.methods}
        for metric in metrics
    }
    cells = {
        method: {
            metric: _cell(scores[metric][method], of_method[method], METRICS[metric], definition.published.get(method))
            for metric in metrics
        }
        for method in plan.methods
    }
    top = table.races[0].time_limit * bounds(table.races[0].env.vehicle.v_max)[1]
    return TableResult(
        table,
        definition.title,
        metrics,
        cells,
        tuple(_comparisons(plan.methods, scores)),
        {method: each / top for method, each in scores["progress_m"].items()},
    )


def seed_scores(rows: pd.DataFrame, metric: Metric) -> np.ndarray:
    """The mean of a metric for every seed and task, both in order of their names: (seeds, tasks)."""
    values = pd.DataFrame({"seed": rows["training_seed"], "task": rows["task"], "value": metric.values(rows)})
    return values.pivot_table(index="seed", columns="task", values="value", aggfunc="mean").to_numpy(np.float64)


def _cell(scores: np.ndarray, rows: pd.DataFrame, metric: Metric, published: Published | None) -> Cell:
    estimate = estimate_mean(scores.mean(axis=1))
    low, high = stratified_bootstrap([scores], lambda found: interquartile_mean(found[0]))
    each = metric.values(rows)
    least, most = (0.0, metric.most) if metric.per_paper_episodes else (-math.inf, math.inf)
    return Cell(
        mean=estimate.mean,
        low=max(estimate.low, least),
        high=min(estimate.high, most),
        sd=float(each.std(ddof=1)) if len(each) > 1 else math.nan,
        seeds=len(scores),
        iqm=interquartile_mean(scores),
        iqm_low=low,
        iqm_high=high,
        published=metric.published(published) if published else None,
    )


def _comparisons(methods: Mapping[str, Method], scores: Mapping[str, Mapping[str, np.ndarray]]) -> list[Comparison]:
    pairs = [(name, other) for name, method in methods.items() for other in method.against if other in methods]
    found = []
    for name, other in pairs:
        for metric in (each for each in scores if METRICS[each].better):
            better = METRICS[metric].better
            a, b = scores[metric][name], scores[metric][other]
            difference = paired_difference(a, b)
            ends = difference.low, difference.high
            probability = probability_of_improvement(better * a, better * b)
            interval = probability_of_improvement_interval(better * a, better * b)
            claim = claim_of(*(better * end for end in ends))
            found.append(Comparison(metric, name, other, difference.mean, *ends, probability, *interval, claim))
    return found


def claim_of(one_end: float, other_end: float) -> str:
    """What an interval of a difference shows, more being better: nothing where it spans zero, or there is none."""
    low, high = min(one_end, other_end), max(one_end, other_end)
    if low > 0.0:
        return "better"
    if high < 0.0:
        return "worse"
    return "not shown"


def entries(result: TableResult) -> dict[str, Any]:
    """Return the numbers of a table for JSON, by method and metric."""
    return {
        method: {metric: {"value": cell.mean, **_without_mean(cell)} for metric, cell in row.items()}
        for method, row in result.cells.items()
    }


def _without_mean(cell: Cell) -> dict[str, Any]:
    return {name: value for name, value in asdict(cell).items() if name != "mean"}


def ratio_over_adaptations(updates: pd.DataFrame, rule: str, reference: str, column: str) -> dict[str, Any]:
    """How a number of one clip rule's updates compares with another's on the same batches.

    Args:
        updates: rows with `seed` (of the training), `adaptation_seed`, `rule` and the column.
        rule, reference: names of clip rules.
        column: positive numbers, one an adaptation; where there are more, their median is taken.

    Returns:
        The geometric mean of the ratio as `value`, with Student's t interval of its logarithm over trainings, each of
        which is the mean of its adaptations; how many `seeds` and `adaptations` there are.
    """
    medians = updates.pivot_table(index=["seed", "adaptation_seed"], columns="rule", values=column, aggfunc="median")
    logs = pd.DataFrame(
        {
            "seed": medians.index.get_level_values("seed"),
            "log": np.log(medians[rule].to_numpy(np.float64) / medians[reference].to_numpy(np.float64)),
        }
    )
    estimate = estimate_mean(logs.pivot_table(index="seed", values="log").to_numpy(np.float64)[:, 0])
    ends = {"value": estimate.mean, "low": estimate.low, "high": estimate.high}
    found = {name: math.exp(end) if math.isfinite(end) else math.nan for name, end in ends.items()}
    return {**found, "seeds": int(medians.index.get_level_values("seed").nunique()), "adaptations": len(medians)}
