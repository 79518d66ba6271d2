"""Row loops on PyTorch's threads: every row once, whatever the number of threads."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
import torch
from numba import cfunc

from outlap.mql import torch_threads
from outlap.mql.torch_threads import (
    BLOCK,
    ROW_LOOP,
    ROWS_OF_THREAD,
    RowLoop,
    bfloats,
    floats,
    integers,
    load,
    store,
    take,
)


@cfunc(ROW_LOOP)
def add_step_times_weight(given):
    rows, step, total, weight = given[1], given[2], floats(given[3]), integers(given[4])
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + BLOCK, rows)):
            total[i] += step * weight[i]
        begin = take(given)


@cfunc(ROW_LOOP)
def round_and_back(given):
    rows, exact, halves, rounded = given[1], floats(given[3]), bfloats(given[4]), floats(given[5])
    begin = take(given)
    while begin < rows:
        for i in range(begin, min(begin + BLOCK, rows)):
            store(halves, i, load(exact, i))
            store(rounded, i, load(halves, i))
        begin = take(given)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("rows", [1, BLOCK, 2 * ROWS_OF_THREAD - 1, 2 * ROWS_OF_THREAD, 10_001])
@pytest.mark.parametrize("number", [1, 2, 5])
@pytest.mark.usefixtures("threads")
def test_every_row_is_gone_through_once_in_every_step(rows: int, number: int) -> None:
    torch.set_num_threads(number)
    total, weight = torch.zeros(rows), torch.arange(rows)
    loop = RowLoop(add_step_times_weight, rows, total, weight)
    for step in range(50):
        loop(step)
    torch.testing.assert_close(total, weight * float(sum(range(50))), atol=0.0, rtol=0.0)


@pytest.mark.skipif(sys.platform != "linux", reason="PyTorch brings other threads")
def test_pytorchs_own_threads_are_found() -> None:
    assert torch_threads._parallel() is not None


@pytest.mark.usefixtures("threads")
def test_without_pytorchs_openmp_one_thread_does_it_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_threads, "_parallel", lambda: None)
    torch.set_num_threads(2)
    total = torch.zeros(1000)
    RowLoop(add_step_times_weight, 1000, total, torch.arange(1000))(3)
    torch.testing.assert_close(total, 3.0 * torch.arange(1000), atol=0.0, rtol=0.0)


def test_bfloat16_is_rounded_as_pytorch_does() -> None:
    bits = torch.randint(-(2**31), 2**31, (100_000,), generator=torch.Generator().manual_seed(0))
    ties = (torch.arange(1000) << 16) + 0x8000 + (0x4000 << 16)
    exact = torch.cat([bits, ties]).to(torch.int32).view(torch.float32)
    exact = torch.cat([exact[exact.isfinite()], torch.tensor([0.0, -0.0, torch.inf, -torch.inf, torch.nan])])
    halves, rounded = torch.empty_like(exact, dtype=torch.bfloat16), torch.empty_like(exact)
    RowLoop(round_and_back, len(exact), exact, halves, rounded)(0)
    torch.testing.assert_close(halves, exact.bfloat16(), atol=0.0, rtol=0.0, equal_nan=True)
    torch.testing.assert_close(rounded, exact.bfloat16().float(), atol=0.0, rtol=0.0, equal_nan=True)


@pytest.mark.parametrize("total", [torch.zeros(4, 2)[:, 0], torch.zeros(4, dtype=torch.float64)])
def test_what_a_kernel_cannot_read_is_refused(total: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"contiguous tensors of the CPU, of torch\.float32"):
        RowLoop(add_step_times_weight, 4, total, torch.arange(4))
