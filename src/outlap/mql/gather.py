"""Rows of several arrays, side by side as float32: one pass over memory, on PyTorch's threads."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numba import cfunc

from outlap.mql.torch_threads import BLOCK, ROW_LOOP, floats, halves, integers, row_loop, take, widen


def gather_rows(sources: Mapping[str, np.ndarray], rows: np.ndarray) -> tuple[np.ndarray, dict[str, slice]]:
    """The same rows of every source, side by side.

    Args:
        sources: (capacity, size) each, float32 or float16.
        rows: int64 (n,), or -1 for zeros.

    Returns:
        float32 (n, sum of sizes), and the columns of each source in it.

    Raises IndexError for a row that a source does not have, and ValueError for other types of number.
    """
    if rows.size and (rows.min() < -1 or any(rows.max() >= len(source) for source in sources.values())):
        raise IndexError(f"rows are {rows.min()} … {rows.max()}; sources have {[len(s) for s in sources.values()]}")
    columns, width = {}, 0
    for name, source in sources.items():
        columns[name] = slice(width, width + source.shape[1])
        width += source.shape[1]
    out = torch.empty(len(rows), width)
    given = [
        number
        for source in map(torch.from_numpy, sources.values())
        for number in (source, int(source.dtype == torch.float16), source.shape[1])
    ]
    row_loop(_gather, len(rows), torch.from_numpy(rows), out, width, len(sources), *given)
    return out.numpy(), columns


@cfunc(ROW_LOOP, cache=True)
def _gather(given):
    rows, index, out, width, sources = given[1], integers(given[2]), floats(given[3]), given[4], given[5]
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + np.uint64(BLOCK), rows)):
            at = width * i
            for source in range(sources):
                address, half, size = given[6 + 3 * source], given[7 + 3 * source], given[8 + 3 * source]
                if index[i] < 0:
                    for k in range(size):
                        out[at + k] = np.float32(0.0)
                elif half:
                    row = np.uint64(index[i]) * size
                    for k in range(size):
                        out[at + k] = widen(halves(address)[row + k])
                else:
                    row = np.uint64(index[i]) * size
                    for k in range(size):
                        out[at + k] = floats(address)[row + k]
                at += size
        begin = take(given)
