"""Registers in kernels: each operation against NumPy's."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from outlap.mql.lanes import LANES, ROWS, clip, load, product, splat, store
from outlap.mql.torch_threads import floats

ONE = np.uint64(1)


def address(values: np.ndarray) -> np.uint64:
    assert values.dtype == np.float32
    assert values.flags.c_contiguous
    return np.uint64(values.ctypes.data)


@njit
def operate(left, right, out):
    a, b, lanes = load(floats(left), np.uint64(1)), load(floats(right), np.uint64(0)), np.uint64(LANES)
    each = (a + b, a - b, a * b, a / b, clip(a, splat(np.float32(-0.5)), b))
    for k in range(5):
        store(floats(out), lanes * np.uint64(k), each[k])


def test_operations_are_those_of_numpy_in_every_lane() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=LANES + 1).astype(np.float32), rng.uniform(0.1, 1.0, LANES).astype(np.float32)
    left[3] = np.nan
    out = np.empty((5, LANES), np.float32)
    operate(address(left), address(right), address(out))
    a = left[1:]
    expected = [a + right, a - right, a * right, a / right, np.clip(a, np.float32(-0.5), right)]
    np.testing.assert_array_equal(out, np.stack(expected))


@pytest.mark.parametrize("rows", [1, ROWS, 2 * ROWS + 3])
@pytest.mark.parametrize("registers", [2, 3])
def test_a_product_is_added_as_numpys_is_and_leaves_everything_else(rows: int, registers: int) -> None:
    add: Any = product(registers)

    @njit
    def call(rows, a, a_first, a_row, b, height, panels, c, c_first, c_row, c_apart, c_next):
        add(rows, floats(a), a_first, a_row, floats(b), height, panels, floats(c), c_first, c_row, c_apart, c_next)

    rng = np.random.default_rng(1)
    height, panels, apart, width, first = 19, 2, LANES + 3, 200, 7
    next_panel = registers * apart + 1
    a, b = (rng.normal(size=size).astype(np.float32) for size in ((rows, 24), (panels, height, registers, LANES)))
    c = rng.normal(size=(rows, width)).astype(np.float32)
    before, expected = c.copy(), c.astype(np.float64)
    touched = np.zeros(width, bool)
    numbers = [rows, address(a), 2, 24, address(b), height, panels, address(c), first, width, apart, next_panel]
    call(*(np.uint64(number) for number in numbers))
    for panel in range(panels):
        for register in range(registers):
            at = first + panel * next_panel + register * apart
            expected[:, at : at + LANES] += a[:, 2 : 2 + height].astype(np.float64) @ b[panel, :, register]
            touched[at : at + LANES] = True
    np.testing.assert_allclose(c, expected, atol=1e-5)
    np.testing.assert_array_equal(c[:, ~touched], before[:, ~touched])


OLDER = """
import numpy as np, torch
from outlap.mql.gather import gather
from outlap.mql.gru import Layer, gru
from outlap.mql.lanes import LANES

halves = np.arange(-30, 30).astype(np.float16)[:, None]
found = gather({"halves": halves}, np.arange(60))["halves"]
steps, valid, later = torch.randn(4, 9, 5), torch.ones(4, 9), torch.ones(9, dtype=torch.int64)
layers = [Layer(torch.randn(24, size), torch.randn(24), torch.randn(24, 8), torch.randn(24)) for size in (5, 8)]
made = []
for kind in (torch.float32, torch.float64):
    given = [Layer(*(tensor.to(kind, copy=True).requires_grad_() for tensor in layer)) for layer in layers]
    both = gru(steps.to(kind), valid.to(kind), 3, given, later)
    both[0].sum().backward()
    every = *both, *(tensor.grad for layer in given for tensor in layer)
    made.append(torch.cat([tensor.flatten() for tensor in every]))
off = (made[0] - made[1]).norm() / made[1].norm()
print(LANES, (found == halves).all(), float(off) < 1e-6)
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="of processors of this kind")
def test_an_older_processor_has_smaller_registers_and_the_same_results(tmp_path: Path) -> None:
    older = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    said = subprocess.run(
        [sys.executable, "-c", OLDER], env={**os.environ, **older}, capture_output=True, text=True, check=True
    )
    assert said.stdout.split() == ["4", "True", "True"]
