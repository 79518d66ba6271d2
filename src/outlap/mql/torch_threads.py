"""Loops over rows, compiled by Numba, that run on the threads of PyTorch's own operations.

Numba's threads would compete with those: a thread of PyTorch waits for its next operation by spinning for milliseconds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core.ccallback import CFunc
from numba.extending import intrinsic
from torch import Tensor

from outlap.kernel_cache import discard_stale_kernels

BLOCK = 32  # rows that a thread takes at a time
ROWS_OF_THREAD = 64  # with fewer a second thread is not worth its start
DTYPES = (torch.float32, torch.float16, torch.int64)  # for `floats`, `halves` and `integers`
ROW_LOOP = types.void(types.CPointer(types.uint64))  # the signature of a kernel, for `numba.cfunc`


def row_loop(kernel: CFunc, rows: int, *given: int | Tensor) -> None:
    """Have a kernel go through all rows.

    A kernel is given one array: the first row that is not taken yet, rows, and then all that is given here. It takes
    blocks of rows by `take` until none is left. Since blocks are independent, any number of threads gives the same.

    Args:
        kernel: of the signature ROW_LOOP.
        rows: to go through.
        given: whole numbers, and contiguous tensors of the CPU, by their addresses.

    Raises ValueError for other tensors, and for types of number that a kernel cannot read.
    """
    for tensor in (g for g in given if isinstance(g, Tensor)):
        if not tensor.is_contiguous() or not tensor.is_cpu or tensor.dtype not in DTYPES:
            raise ValueError(f"a row loop takes contiguous tensors of the CPU, of {', '.join(map(str, DTYPES))}")
    numbers = np.array([0, rows, *(g.data_ptr() if isinstance(g, Tensor) else g for g in given)], np.uint64)
    threads = min(torch.get_num_threads(), rows // ROWS_OF_THREAD)
    parallel = _parallel() if threads > 1 else None
    if parallel is None:
        kernel.ctypes(ctypes.cast(numbers.ctypes.data, ctypes.POINTER(ctypes.c_uint64)))
    else:
        parallel(kernel.address, numbers.ctypes.data, threads, 0)


def blocks_of(rows: int) -> int:
    """How many blocks so many rows are."""
    return -(-rows // BLOCK)


@cache
def _parallel() -> Callable[..., None] | None:
    """`GOMP_parallel` of the very OpenMP library that PyTorch is linked to; None where that is another or none."""
    try:
        function = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libtorch_cpu.so")).GOMP_parallel
    except (OSError, AttributeError):
        return None
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
    function.restype = None
    return function


def _take(typingctx, given):
    def code(context, builder, signature, arguments):
        return builder.atomic_rmw("add", arguments[0], ir.Constant(ir.IntType(64), BLOCK), "monotonic")

    return types.uint64(types.CPointer(types.uint64)), code


def _pointer(kind: types.Type):
    def at(typingctx, address):
        def code(context, builder, signature, arguments):
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.uint64), code

    return at


def _widen(typingctx, half):
    # Moved to a float's place the exponent is 112 too small. LLVM's own conversion ends the process without F16C.
    def code(context, builder, signature, arguments):
        word, number = ir.IntType(32), ir.FloatType()
        bits = builder.zext(arguments[0], word)
        small = builder.shl(builder.and_(bits, word(0x7FFF)), word(13))
        exact = builder.bitcast(builder.fmul(builder.bitcast(small, number), number(2.0**112)), word)
        endless = builder.icmp_unsigned(">=", small, word(0x7C00 << 13))  # or no number
        exact = builder.select(endless, builder.or_(small, word(0x7F800000)), exact)
        sign = builder.shl(builder.and_(bits, word(0x8000)), word(16))
        return builder.bitcast(builder.or_(exact, sign), number)

    return types.float32(types.uint16), code


# In kernels:
take: Any = intrinsic(_take)  # (given): the first row of a block, which no other thread gets
integers: Any = intrinsic(_pointer(types.int64))  # (address): the numbers there
floats: Any = intrinsic(_pointer(types.float32))
halves: Any = intrinsic(_pointer(types.uint16))  # float16, for `widen`
widen: Any = intrinsic(_widen)  # (a number of `halves`): float32


@njit(cache=True)
def _probe():
    return 0


# Kernels are compiled from these, too.
discard_stale_kernels(_probe, [Path(__file__), Path(__file__).with_name("lanes.py")])
