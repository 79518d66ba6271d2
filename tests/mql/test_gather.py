"""Rows of several arrays side by side, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.mql.gather import gather, gather_side_by_side


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_rows_are_those_of_numpy_as_float32(n: int) -> None:
    rng = np.random.default_rng(0)
    sources = {
        "half": rng.normal(size=(50, 37)).astype(np.float16),
        "one": rng.normal(size=(50, 1)).astype(np.float32),
        "none": np.empty((50, 0), np.float32),
        "three": rng.normal(size=(50, 3)).astype(np.float32),
    }
    rows = rng.integers(-1, 50, n)
    found, columns = gather_side_by_side(sources, rows)
    apart = gather(sources, rows)
    assert found.dtype == np.float32
    assert found.shape == (n, 41)
    assert list(columns) == list(apart) == list(sources)
    for name, place in columns.items():
        expected = np.where(rows[:, None] >= 0, sources[name][rows], 0).astype(np.float32)
        np.testing.assert_array_equal(found[:, place], expected)
        np.testing.assert_array_equal(apart[name], expected)
        assert apart[name].flags.c_contiguous


@pytest.mark.parametrize("row", [-2, 4])
def test_a_row_that_a_source_does_not_have_is_refused(row: int) -> None:
    with pytest.raises(IndexError, match=f"rows are {min(row, 0)} … {max(row, 0)}; the shortest source has 4"):
        gather({"a": np.zeros((5, 1), np.float32), "b": np.zeros((4, 1), np.float32)}, np.array([0, row]))


@pytest.mark.parametrize(
    ("source", "rows", "named"),
    [
        (np.zeros((5, 1)), np.array([0]), "a is float64"),
        (np.zeros((5, 1), np.int64), np.array([0]), "a is int64"),
        (np.zeros((5, 1, 1), np.float32), np.array([0]), "a is float32 with 3 axes"),
        (np.zeros((5, 1), np.float32), np.array([0.0], np.float32), "rows are float32"),
    ],
)
def test_what_a_kernel_would_misread_is_refused(source: np.ndarray, rows: np.ndarray, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        gather({"a": source}, rows)
