"""Row loops on PyTorch's threads: every row once, whatever the number of threads."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
import torch
from numba import cfunc

from outlap.mql import torch_threads
from outlap.mql.torch_threads import BLOCK, ROW_LOOP, ROWS_OF_THREAD, floats, halves, integers, row_loop, take, widen


@cfunc(ROW_LOOP)
def add_weight(given):
    rows, total, weight = given[1], floats(given[2]), integers(given[3])
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + BLOCK, rows)):
            total[i] += weight[i]
        begin = take(given)


@cfunc(ROW_LOOP)
def to_floats(given):
    rows, exact, found = given[1], halves(given[2]), floats(given[3])
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + BLOCK, rows)):
            found[i] = widen(exact[i])
        begin = take(given)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("rows", [1, BLOCK, 2 * ROWS_OF_THREAD - 1, 2 * ROWS_OF_THREAD, 10_001])
@pytest.mark.parametrize("number", [1, 2, 5])
@pytest.mark.usefixtures("threads")
def test_every_row_is_gone_through_once(rows: int, number: int) -> None:
    torch.set_num_threads(number)
    total, weight = torch.zeros(rows), torch.arange(rows)
    for _ in range(50):
        row_loop(add_weight, rows, total, weight)
    torch.testing.assert_close(total, weight * 50.0, atol=0.0, rtol=0.0)


@pytest.mark.skipif(sys.platform != "linux", reason="PyTorch brings other threads")
def test_pytorchs_own_threads_are_found() -> None:
    assert torch_threads._parallel() is not None


@pytest.mark.usefixtures("threads")
def test_without_pytorchs_openmp_one_thread_does_it_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_threads, "_parallel", lambda: None)
    torch.set_num_threads(2)
    total = torch.zeros(1000)
    row_loop(add_weight, 1000, total, torch.arange(1000))
    torch.testing.assert_close(total, 1.0 * torch.arange(1000), atol=0.0, rtol=0.0)


def test_every_half_is_read_as_pytorch_does() -> None:
    exact = torch.arange(-(2**15), 2**15).to(torch.int16).view(torch.float16)
    found = torch.empty(2**16)
    row_loop(to_floats, len(exact), exact, found)
    torch.testing.assert_close(found, exact.float(), atol=0.0, rtol=0.0, equal_nan=True)


@pytest.mark.parametrize("total", [torch.zeros(4, 2)[:, 0], torch.zeros(4, dtype=torch.float64)])
def test_what_a_kernel_cannot_read_is_refused(total: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"contiguous tensors of the CPU, of torch\.float32"):
        row_loop(add_weight, 4, total, torch.arange(4))
