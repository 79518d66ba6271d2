"""Any runs raced against each other on the same episodes.

Runs whose configurations differ in nothing but the seed are trainings of one method. Where every method has two or
more, the seed is the unit of the intervals; else it is the episode, and they hold for these very policies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from outlap.drivers.driver import Driver
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.hot_spots import hot_spots
from outlap.evaluation.protocol import made_for
from outlap.evaluation.results import ROWS, write_rows
from outlap.evaluation.rollout import evaluate
from outlap.evaluation.statistics import Estimate, estimate_mean, paired_difference, wilson_interval
from outlap.experiments.document import Document
from outlap.experiments.figures import draw_intervals
from outlap.experiments.results import METRICS, PAPER_EPISODES, Difference, difference, metrics_of, seed_scores
from outlap.files import atomic_write, to_json
from outlap.track.track import Track
from outlap.training.run import Run

SKIPPED = ("episode_length", "reward")  # of the paper's short races


@dataclass(frozen=True)
class Subject:
    """A driver, with its run if it was trained."""

    name: str
    driver: Driver
    run: Run | None

    @property
    def seed(self) -> int:
        """Of its training."""
        return self.run.config.seed if self.run else 0

    @property
    def method(self) -> str:
        """What tells it from other methods; of one that was not trained, its name."""
        return self.name if self.run is None else self.run.method


def group(subjects: Sequence[Subject]) -> dict[str, list[Subject]]:
    """Subjects by method; a method is called by its first run, and by how many there are.

    Raises OutlapError for two of one method and seed.
    """
    found: dict[str, list[Subject]] = {}
    for subject in subjects:
        members = found.setdefault(subject.method, [])
        if any(subject.seed == other.seed for other in members):
            raise OutlapError(
                f"{subject.name}: is there twice, or another run has its configuration and seed; leave one out"
            )
        members.append(subject)
    labels = [each[0].name + (f" ({len(each)} seeds)" if len(each) > 1 else "") for each in found.values()]
    return {
        label if labels.count(label) == 1 else f"{label} #{number + 1}": each
        for number, (label, each) in enumerate(zip(labels, found.values(), strict=True))
    }


def race_subjects(
    groups: Mapping[str, Sequence[Subject]],
    races: RaceConfig,
    tracks: Sequence[Track],
    episodes: int,
    seed: int,
    on_progress: Callable[[int, str], None],
) -> pd.DataFrame:
    """Race every subject on the same episodes.

    Args:
        groups: of `group`.
        races: the task; of a driver with a scanner and a top speed of its own, those stay.
        tracks: to race on.
        episodes: on each track.
        seed: of the episodes.
        on_progress: called with the number of episodes that are done, all together, and the subject's name.

    Returns:
        The rows of `evaluate`, with `method`, `training_seed` and `task`.
    """
    rows: list[pd.DataFrame] = []
    for method, members in groups.items():
        for subject in members:
            before = len(rows) * len(tracks) * episodes
            raced = evaluate(
                subject.driver, made_for(subject.driver, races), tracks, episodes, seed, lap_time_ratios=False,
                on_progress=lambda now, before=before, name=subject.name: on_progress(before + int(now.done), name),
            )  # fmt: skip
            rows.append(raced.assign(method=method, training_seed=subject.seed, task=raced["track"]))
    return pd.concat(rows, ignore_index=True)


def compare(rows: pd.DataFrame, methods: Sequence[str], alone: bool) -> tuple[dict[str, Any], list[Difference], bool]:
    """The numbers of every method, and its differences from the first one.

    Args:
        rows: with `method`, `training_seed`, `task` and `seed`.
        methods: their names, the first one being what the others are compared with.
        alone: without other cars.

    Returns:
        Estimates by method and metric; the differences; whether the seed is the unit.
    """
    metrics = [name for name in metrics_of(1 if alone else 2) if name not in SKIPPED]
    of_method = {method: rows.loc[rows["method"] == method] for method in methods}
    seeds = {method: set(mine["training_seed"].tolist()) for method, mine in of_method.items()}
    by_seed = min(map(len, seeds.values())) > 1
    cells: dict[str, Any] = {method: {} for method in methods}
    differences = []
    for metric in metrics:
        values = {method: _values(mine, metric, by_seed) for method, mine in of_method.items()}
        for method in methods:
            cells[method][metric] = estimate_mean(values[method].mean(axis=1))
        if metric == "crashes" and not by_seed:
            for method, mine in of_method.items():
                if len(seeds[method]) == 1:  # races of several runs on the same episodes are not independent
                    cells[method][metric] = _of_crashes(mine, cells[method][metric])
        first = methods[0]
        for method in methods[1:] if METRICS[metric].better else ():
            paired = not by_seed or seeds[method] == seeds[first]
            estimate = _difference(values[method], values[first], paired)
            differences.append(difference(metric, method, first, estimate))
    return cells, differences, by_seed


def _values(rows: pd.DataFrame, metric: str, by_seed: bool) -> np.ndarray:
    """Return (seeds, tasks), or (episodes, 1) in which the runs of a method are averaged."""
    if by_seed:
        return seed_scores(rows, METRICS[metric])
    values = rows.assign(value=METRICS[metric].values(rows))
    return values.pivot_table(index=["task", "seed"], values="value").to_numpy(np.float64)


def _of_crashes(rows: pd.DataFrame, estimate: Estimate) -> Estimate:
    """Return the estimate with Wilson's interval, which has a width for no crash too."""
    crashed = METRICS["crashes"].of_rows(rows)
    low, high = wilson_interval(int(crashed.sum()), len(crashed))
    return estimate._replace(low=PAPER_EPISODES * low, high=PAPER_EPISODES * high)


def _difference(a: np.ndarray, b: np.ndarray, paired: bool) -> Estimate:
    if paired:
        return paired_difference(a, b)
    # Welch's interval: other seeds cannot be paired.
    left, right = a.mean(axis=1), b.mean(axis=1)
    low, high = stats.ttest_ind(left, right, equal_var=False).confidence_interval()
    return Estimate(float(left.mean() - right.mean()), float("nan"), float(low), float(high))


def write_comparison(
    folder: Path,
    rows: pd.DataFrame,
    groups: Mapping[str, Sequence[Subject]],
    alone: bool,
    lengths: Mapping[str, float],
    record: Mapping[str, Any],
) -> dict[str, Any]:
    """Write `report.md`, `report.html`, `results.json`, the figure and the rows; return the content of the JSON.

    Args:
        folder: to write to.
        rows: of `race_subjects`.
        groups: of `group`.
        alone: without other cars.
        lengths: of the centreline of each track [m], by name.
        record: what is needed to repeat it.
    """
    methods = list(groups)
    cells, differences, by_seed = compare(rows, methods, alone)
    episodes = len(rows) // sum(len(each) for each in groups.values())
    unit = "the seed of a training" if by_seed else "the episode: it says nothing of other trainings of a method"
    tracks = ", ".join(dict.fromkeys(rows["task"].tolist()))
    document = Document(folder)
    document.text(f"# {', '.join(methods)}")
    document.text(f"{episodes} episodes on {tracks}, the same for everybody. The unit of intervals is {unit}.")
    document.table(
        {"method": method}
        | {METRICS[name].heading: METRICS[name].text(each.mean, each.low, each.high) for name, each in row.items()}
        for method, row in cells.items()
    )
    document.figure("comparison", draw_intervals(cells, ("crashes", "progress_m")))
    document.table(each.row({method: method for method in methods}) for each in differences)
    spots = {method: hot_spots(rows.loc[rows["method"] == method], lengths) for method in methods}
    if any(spots.values()):
        document.text("## Crash hot spots")
        document.table(
            {
                "method": method, "track": spot["track"], "at [m]": f"{spot['s_m']:.1f}",
                "crashes": str(spot["crashes"]), "share of the track's": f"{spot['share']:.0%}",
            }
            for method, found in spots.items()
            for spot in found
        )  # fmt: skip
    data = {
        "unit": "seed" if by_seed else "episode",
        "methods": {method: {name: each._asdict() for name, each in row.items()} for method, row in cells.items()},
        "differences": [asdict(each) for each in differences],
        "hot_spots": spots,
        "runs": {method: [each.name for each in subjects] for method, subjects in groups.items()},
        "record": record,
    }
    write_rows(rows, folder / ROWS)
    atomic_write(folder / "results.json", to_json(data) + "\n")
    document.save(", ".join(methods))
    return data
