"""The same rows of several arrays as float32: one pass over memory, on PyTorch's threads."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numba import cfunc
from torch import Tensor

from outlap.mql.torch_threads import BLOCK, ROW_LOOP, floats, halves, integers, row_loop, take, widen


def gather(sources: Mapping[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of every source, each by itself.

    Args:
        sources: (capacity, size) each, float32 or float16.
        rows: int64 (n,), or -1 for zeros.

    Returns:
        float32 (n, size) of every source.

    Raises IndexError for a row that a source does not have, and ValueError for other types of number or axes.
    """
    out = {name: torch.empty(len(rows), source.shape[1]) for name, source in sources.items()}
    _copy(sources, rows, [(part, 0, part.shape[1]) for part in out.values()])
    return {name: part.numpy() for name, part in out.items()}


def gather_side_by_side(sources: Mapping[str, np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, dict[str, slice]]:
    """`gather` into one array: float32 (n, sum of sizes), and the columns of each source in it."""
    columns, width = {}, 0
    for name, source in sources.items():
        columns[name] = slice(width, width + source.shape[1])
        width += source.shape[1]
    out = torch.empty(len(rows), width)
    _copy(sources, rows, [(out, place.start, width) for place in columns.values()])
    return out.numpy(), columns


def _copy(sources: Mapping[str, np.ndarray], rows: np.ndarray, to: list[tuple[Tensor, int, int]]) -> None:
    """Each source's rows to a tensor, from a column of its first row on, and so many numbers on for the next."""
    for name, source in sources.items():
        if source.dtype not in (np.float32, np.float16) or source.ndim != 2:
            raise ValueError(f"{name} is {source.dtype} with {source.ndim} axes; must be float32 or float16 with 2")
    if rows.dtype != np.int64 or rows.ndim != 1:
        raise ValueError(f"rows are {rows.dtype} with {rows.ndim} axes; must be int64 with 1")
    shortest = min(map(len, sources.values()), default=0)
    if rows.size and (rows.min() < -1 or rows.max() >= shortest):
        raise IndexError(f"rows are {rows.min()} … {rows.max()}; the shortest source has {shortest}")
    given: list[int | Tensor] = []
    for source, (out, column, row) in zip(map(torch.from_numpy, sources.values()), to, strict=True):
        given += [source, int(source.dtype == torch.float16), source.shape[1], out, column, row]
    row_loop(_copy_rows, len(rows), torch.from_numpy(rows), len(sources), *given)


@cfunc(ROW_LOOP, cache=True)
def _copy_rows(given):
    rows, index, sources = given[1], integers(given[2]), given[3]
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + np.uint64(BLOCK), rows)):
            for source in range(sources):
                k = 4 + 6 * source
                address, half, size, out = given[k], given[k + 1], given[k + 2], floats(given[k + 3])
                at = given[k + 4] + given[k + 5] * i
                if index[i] < 0:
                    for j in range(size):
                        out[at + j] = np.float32(0.0)
                elif half:
                    row = np.uint64(index[i]) * size
                    for j in range(size):
                        out[at + j] = widen(halves(address)[row + j])
                else:
                    row = np.uint64(index[i]) * size
                    for j in range(size):
                        out[at + j] = floats(address)[row + j]
        begin = take(given)
