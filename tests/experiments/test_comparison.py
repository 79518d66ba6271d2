"""Runs against each other: who counts as trainings of one method, and what the unit of an interval is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from outlap.drivers.classical import FollowTheGap
from outlap.errors import OutlapError
from outlap.evaluation.statistics import wilson_interval
from outlap.experiments.comparison import Subject, compare, group
from outlap.training.ppo import PPOConfig
from outlap.training.run import Run


def subject(name: str, **changes) -> Subject:
    return Subject(name, FollowTheGap(), Run(Path(name), PPOConfig(**changes)))


def test_runs_that_differ_in_the_seed_alone_are_one_method():
    subjects = [
        subject("a", seed=0), subject("b", seed=1), subject("c", gamma=0.9), subject("a", gamma=0.95),
        Subject("follow-the-gap", FollowTheGap(), None),
    ]  # fmt: skip
    groups = {label: [each.name for each in members] for label, members in group(subjects).items()}
    assert groups == {"a (2 seeds)": ["a", "b"], "c": ["c"], "a": ["a"], "follow-the-gap": ["follow-the-gap"]}


def test_the_same_training_twice_is_refused():
    with pytest.raises(OutlapError, match="is there twice"):
        group([subject("a", seed=3), subject("b", seed=4), subject("a", seed=3)])


def test_methods_of_one_name_are_told_apart():
    assert list(group([subject("x/run", gamma=0.9), subject("x/run", gamma=0.8)])) == ["x/run #1", "x/run #2"]


def races(crashes: dict[tuple[str, int], int], episodes: int = 50) -> pd.DataFrame:
    """Rows in which the first so many of the episodes crash, by method and run."""
    rows = []
    for (method, run), count in crashes.items():
        for task in ("s", "t"):
            for episode in range(episodes):
                over = episode < count
                rows.append(
                    {
                        "method": method, "training_seed": run, "task": task, "seed": episode,
                        "outcome": "crash" if over else "timeout", "episode_return": 0.0, "mean_speed_mps": 5.0,
                        "progress_m": 10.0 * (episode % 7) + (0.0 if over else 20.0),
                    }
                )  # fmt: skip
    return pd.DataFrame(rows)


def test_one_run_each_is_compared_by_episodes_on_equal_seeds():
    cells, differences, by_seed = compare(races({("a", 0): 0, ("b", 0): 10}), ["a", "b"], alone=True)
    assert not by_seed
    low, high = wilson_interval(0, 100)
    assert (cells["a"]["crashes"].mean, cells["a"]["crashes"].low) == (0.0, 500 * low)
    assert cells["a"]["crashes"].high == pytest.approx(500 * high)
    crashes, progress = differences
    assert (crashes.metric, crashes.method, crashes.other, crashes.difference) == ("crashes", "b", "a", 100.0)
    assert (crashes.claim, progress.claim) == ("worse", "worse")
    # Progress differs by 20 m in the ten episodes that crash, and by nothing in the others, whatever their own spread.
    each = np.repeat([-20.0, 0.0], [20, 80])
    assert progress.difference == pytest.approx(each.mean())
    assert progress.high - progress.low == pytest.approx(2 * 1.984217 * each.std(ddof=1) / 10)


def test_several_runs_of_both_are_compared_by_seeds():
    rows = races({("a", 0): 10, ("a", 1): 12, ("a", 2): 11, ("b", 0): 20, ("b", 1): 23, ("b", 2): 21})
    cells, differences, by_seed = compare(rows, ["a", "b"], alone=True)
    assert by_seed
    assert cells["a"]["crashes"].mean == pytest.approx(110.0)
    assert differences[0].claim == "worse"
    # Seeds are paired by their numbers, and not by their order.
    backwards = rows.iloc[::-1].reset_index(drop=True)
    assert compare(backwards, ["a", "b"], alone=True)[1][0] == differences[0]
    unequal = compare(rows.loc[~((rows["method"] == "b") & (rows["training_seed"] == 2))], ["a", "b"], alone=True)
    assert unequal[2]
    assert unequal[1][0].difference == pytest.approx(215.0 - 110.0)
    assert unequal[1][0].low < 105.0 < unequal[1][0].high
