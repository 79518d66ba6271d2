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
    Estimate,
    estimate_mean,
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
    probability_of_improvement_interval,
    stratified_bootstrap,
)
from outlap.experiments.plan import Plan, TablePlan

PAPER_EPISODES = 500  # that counts are given for
PAPER_STEP = 0.01  # [s] that episode lengths are counted in


@dataclass(frozen=True)
class Metric:
    """A number of an episode, and how it is reported."""

    heading: str
    of_rows: Callable[[pd.DataFrame], Any]  # a column with one number an episode
    better: int  # 1: more is better, -1: less is, 0: methods are not compared in it
    digits: int
    is_count: bool = False  # in 500 episodes, instead of a mean
    most: float = math.inf  # that a count can be

    def values(self, rows: pd.DataFrame) -> np.ndarray:
        """Return a number for each episode, such that their mean is the metric."""
        return (PAPER_EPISODES if self.is_count else 1) * np.asarray(self.of_rows(rows), np.float64)

    def text(self, mean: float, low: float, high: float, sign: str = "") -> str:
        """Return a mean with its interval, if it has one."""
        return f"{mean:{sign}.{self.digits}f}{interval_text(low, high, self.digits)}"


METRICS: dict[str, Metric] = {
    "overtakes": Metric("overtakes in 500", lambda rows: rows["overtakes"], 1, 0, True),
    "crashes": Metric("crashes in 500", lambda rows: rows["outcome"] == CRASH, -1, 0, True, PAPER_EPISODES),
    "episode_length": Metric("length [0.01 s]", lambda rows: rows["duration_s"] / PAPER_STEP, 0, 0),
    "reward": Metric("reward of the last step", lambda rows: rows["last_reward"], 0, 3),
    "return": Metric("return", lambda rows: rows["episode_return"], 0, 1),
    "progress_m": Metric("progress [m]", lambda rows: rows["progress_m"], 1, 1),
    "mean_speed_mps": Metric("speed [m/s]", lambda rows: rows["mean_speed_mps"], 0, 2),
    "places_lost": Metric("places lost in 500", lambda rows: rows["places_lost"], 0, 0, True),
}
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
class Difference:
    """A method against another, in one metric."""

    metric: str
    method: str
    other: str
    difference: float  # method minus other
    low: float
    high: float
    claim: str  # what is shown: better, worse, or not shown

    def row(self, titles: Mapping[str, str]) -> dict[str, str]:
        """Return a row of a table of differences, by heading."""
        metric = METRICS[self.metric]
        return {
            "comparison": f"{titles[self.method]} against {titles[self.other]}",
            "metric": metric.heading,
            "difference [95 %]": metric.text(self.difference, self.low, self.high, sign="+"),
            "shown": f"**{self.claim}**" if self.claim != "not shown" else self.claim,
        }


@dataclass(frozen=True)
class Comparison(Difference):
    """A difference that is paired by seed and task."""

    probability: float  # that a training of `method` is the better one
    probability_low: float
    probability_high: float

    def row(self, titles: Mapping[str, str]) -> dict[str, str]:
        """See `Difference`."""
        interval = interval_text(self.probability_low, self.probability_high, 2)
        row = super().row(titles)
        shown = row.pop("shown")
        return {**row, "probability of improvement [95 %]": f"{self.probability:.2f}{interval}", "shown": shown}


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
    """Return the rows of every race of a plan, each once."""
    rows = [pd.read_parquet(race.folder(work) / ROWS) for table in plan.tables for race in table.races]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def metrics_of(num_cars: int) -> tuple[str, ...]:
    """Return the names of the metrics of races with `num_cars` cars."""
    return tuple(name for name in METRICS if num_cars > 1 or name not in RACING)


def table_result(plan: Plan, table: TablePlan, rows: pd.DataFrame) -> TableResult:
    """Return the numbers of a table from the rows of its races."""
    rows = rows.loc[rows["table"] == table.name]
    of_method = {method: rows.loc[rows["method"] == method] for method in plan.methods}
    definition = plan.task_sets[table.task_set].tables[table.name]
    env = table.races[0].env
    metrics = metrics_of(env.num_cars)
    scores = {
        metric: {method: seed_scores(mine, METRICS[metric]) for method, mine in of_method.items()} for metric in metrics
    }
    cells = {
        method: {
            metric: _cell(
                scores[metric][method], mine, METRICS[metric], getattr(definition.published.get(method), metric, None)
            )
            for metric in metrics
        }
        for method, mine in of_method.items()
    }
    pairs = [(name, other) for name, method in plan.methods.items() for other in method.against if other in of_method]
    comparisons = tuple(
        _comparison(metric, name, other, scores[metric][name], scores[metric][other])
        for name, other in pairs
        for metric in metrics
        if METRICS[metric].better
    )
    top = table.races[0].time_limit * bounds(env.vehicle.v_max)[1]
    progress = {method: each / top for method, each in scores["progress_m"].items()}
    return TableResult(table, definition.title, metrics, cells, comparisons, progress)


def seed_scores(rows: pd.DataFrame, metric: Metric) -> np.ndarray:
    """Return the mean of a metric for every seed and task, both in order of their names: (seeds, tasks)."""
    values = rows.assign(value=metric.values(rows))
    return values.pivot_table(index="training_seed", columns="task", values="value").to_numpy(np.float64)


def _cell(scores: np.ndarray, rows: pd.DataFrame, metric: Metric, published: Any) -> Cell:
    estimate = estimate_mean(scores.mean(axis=1))
    iqm_low, iqm_high = stratified_bootstrap([scores], lambda found: interquartile_mean(found[0]))
    least = 0.0 if metric.is_count else -math.inf
    return Cell(
        mean=estimate.mean,
        low=max(estimate.low, least),
        high=min(estimate.high, metric.most),
        sd=estimate_mean(metric.values(rows)).sd,
        seeds=len(scores),
        iqm=interquartile_mean(scores),
        iqm_low=iqm_low,
        iqm_high=iqm_high,
        published=published,
    )


def difference(metric: str, method: str, other: str, estimate: Estimate) -> Difference:
    """Return what the estimate of a difference shows."""
    better = METRICS[metric].better
    claim = claim_of(better * estimate.low, better * estimate.high)
    return Difference(metric, method, other, estimate.mean, estimate.low, estimate.high, claim)


def _comparison(metric: str, method: str, other: str, a: np.ndarray, b: np.ndarray) -> Comparison:
    better = METRICS[metric].better
    probability = probability_of_improvement(better * a, better * b)
    interval = probability_of_improvement_interval(better * a, better * b)
    return Comparison(
        **asdict(difference(metric, method, other, paired_difference(a, b))),
        probability=probability,
        probability_low=interval[0],
        probability_high=interval[1],
    )


def claim_of(one_end: float, other_end: float) -> str:
    """Return what an interval of a difference shows, more being better: nothing if it spans zero or there is none."""
    if min(one_end, other_end) > 0.0:
        return "better"
    return "worse" if max(one_end, other_end) < 0.0 else "not shown"


def interval_text(low: float, high: float, digits: int) -> str:
    """Return an interval after a number; nothing if there is none."""
    return "" if math.isnan(low) else f" [{low:.{digits}f}, {high:.{digits}f}]"


def entries(result: TableResult) -> dict[str, Any]:
    """Return the numbers of a table for JSON, by method and metric."""
    return {
        method: {
            metric: {"value" if name == "mean" else name: number for name, number in asdict(cell).items()}
            for metric, cell in row.items()
        }
        for method, row in result.cells.items()
    }


def ratio_over_adaptations(updates: pd.DataFrame, rule: str, reference: str, column: str) -> dict[str, Any]:
    """Compare a number of one clip rule's updates with another's on the same batches.

    Args:
        updates: rows with `seed` (of the training), `adaptation_seed`, `rule` and the column.
        rule, reference: names of clip rules.
        column: positive numbers, one an adaptation; where there are more, their median is taken.

    Returns:
        The geometric mean of the ratio as `value`, with Student's t interval of its logarithm over trainings, each of
        which is the mean of its adaptations; the numbers of `seeds` and `adaptations`.
    """
    medians = updates.pivot_table(index=["seed", "adaptation_seed"], columns="rule", values=column, aggfunc="median")
    logs = medians.assign(log=np.log(medians[rule].to_numpy() / medians[reference].to_numpy()))
    by_seed = logs.pivot_table(index="seed", values="log").to_numpy(np.float64)[:, 0]
    estimate = estimate_mean(by_seed)
    ends = {"value": estimate.mean, "low": estimate.low, "high": estimate.high}
    found = {name: math.exp(end) if math.isfinite(end) else math.nan for name, end in ends.items()}
    return {**found, "seeds": len(by_seed), "adaptations": len(medians)}
