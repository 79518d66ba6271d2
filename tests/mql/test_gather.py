"""Rows of several arrays side by side, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from outlap.mql.gather import gather_rows


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
    found, columns = gather_rows(sources, rows)
    assert found.dtype == np.float32
    assert found.shape == (n, 41)
    assert list(columns) == list(sources)
    for name, place in columns.items():
        expected = np.where(rows[:, None] >= 0, sources[name][rows], 0).astype(np.float32)
        np.testing.assert_array_equal(found[:, place], expected)


@pytest.mark.parametrize("row", [-2, 4])
def test_a_row_that_a_source_does_not_have_is_refused(row: int) -> None:
    with pytest.raises(IndexError, match=f"{row}"):
        gather_rows({"a": np.zeros((5, 1), np.float32), "b": np.zeros((4, 1), np.float32)}, np.array([0, row]))


def test_other_types_of_number_are_refused() -> None:
    with pytest.raises(ValueError, match=r"torch\.float32"):
        gather_rows({"a": np.zeros((5, 1))}, np.array([0]))
