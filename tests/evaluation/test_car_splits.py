"""The test cars: where they lie relative to the training ranges, shipped ones and drawn ones alike."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.envs.car_sets import TEST_SPLITS, TRAINING_RANGES, find_cars, scaled
from outlap.errors import OutlapError
from outlap.evaluation.car_splits import SHELLS, draw_split
from synthetic_tracks import ring

DELAYS = [number for number, name in enumerate(TRAINING_RANGES) if name.endswith("_delay")]
DIFFICULT = np.array([each.difficult for each in TRAINING_RANGES.values()])


def in_its_shell(split: str, values: np.ndarray) -> None:
    """Assert that cars (n, parameters) lie in the shell of their split."""
    u = scaled(values)
    low, high = SHELLS[split]
    largest = np.abs(u).max(axis=1)
    assert low - 1e-5 <= largest.min()
    assert largest.max() <= high + 1e-5
    assert (values[:, DELAYS] >= 0.0).all()
    if split == "hard":
        assert (u * DIFFICULT >= -1e-5).all()
    else:
        assert ((u * DIFFICULT < 0.0).mean(axis=0) > 0.2).all()  # both sides of every parameter


@pytest.mark.parametrize("split", TEST_SPLITS)
def test_the_shipped_cars_lie_in_their_shells(split):
    cars = find_cars(split)
    assert cars.size >= 40
    assert cars.parameters == tuple(TRAINING_RANGES)
    in_its_shell(split, cars.values)
    # All distances from the training ranges occur, not the farthest alone.
    low, high = SHELLS[split]
    share = (np.abs(scaled(cars.values)).max(axis=1) - low) / (high - low)
    assert np.histogram(share, 4, (0.0, 1.0))[0].min() >= 0.1 * cars.size


def test_no_car_is_in_two_splits():
    cars = np.concatenate([find_cars(split).values for split in TEST_SPLITS])
    assert len(np.unique(cars, axis=0)) == len(cars)


def test_a_split_is_drawn_by_its_seed():
    first, again, other = (draw_split("outside", 6, seed, [ring()]) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.cars.values, again.cars.values)
    assert (first.cars.values != other.cars.values).any()
    in_its_shell("outside", np.concatenate([first.cars.values, other.cars.values]))


def test_an_unknown_split_is_refused():
    with pytest.raises(OutlapError, match="split is 'far'; must be one of inside, edge, outside, hard"):
        draw_split("far", 1, 0, [ring()])
