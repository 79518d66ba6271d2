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
ROWS_OF_THREAD = 128  # with fewer a second thread is not worth its start
DTYPES = (torch.float32, torch.bfloat16, torch.int64)  # for `floats`, `bfloats` and `integers`
ROW_LOOP = types.void(types.CPointer(types.uint64))  # the signature of a kernel, for `numba.cfunc`


class RowLoop:
    """A kernel and what it works on.

    A kernel is given one array: the first row that is not taken yet, rows, step, and then what the constructor was
    given. It takes blocks of rows by `take` until none is left. Since rows are independent, any number of threads
    gives the same.
    """

    def __init__(self, kernel: CFunc, rows: int, *given: int | Tensor) -> None:
        """Note what the kernel works on.

        Args:
            kernel: of the signature ROW_LOOP.
            rows: to go through.
            given: whole numbers, and contiguous tensors of the CPU, by their addresses.

        Raises ValueError for other tensors, and for types of number that a kernel cannot read.
        """
        for tensor in (g for g in given if isinstance(g, Tensor)):
            if not tensor.is_contiguous() or tensor.device.type != "cpu" or tensor.dtype not in DTYPES:
                raise ValueError(f"a row loop takes contiguous tensors of the CPU, of {', '.join(map(str, DTYPES))}")
        self._kept = given  # tensors, from being freed
        self._given = np.array([0, rows, 0, *(g.data_ptr() if isinstance(g, Tensor) else g for g in given)], np.uint64)
        self._address = self._given.ctypes.data
        self._kernel = kernel
        self._threads = min(torch.get_num_threads(), rows // ROWS_OF_THREAD)

    def __call__(self, step: int) -> None:
        """Go through all rows."""
        self._given[0], self._given[2] = 0, step
        parallel = _parallel() if self._threads > 1 else None
        if parallel is None:
            self._kernel.ctypes(ctypes.cast(self._address, ctypes.POINTER(ctypes.c_uint64)))
        else:
            parallel(self._kernel.address, self._address, self._threads, 0)


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


def _load(typingctx, numbers, index):
    def code(context, builder, signature, arguments):
        value = builder.load(builder.gep(arguments[0], [arguments[1]]))
        if numbers.dtype == types.float32:
            return value
        return builder.bitcast(builder.shl(builder.zext(value, _WORD), _WORD(16)), _FLOAT)

    return types.float32(numbers, index), code


def _store(typingctx, numbers, index, value):
    def code(context, builder, signature, arguments):
        place, value = builder.gep(arguments[0], [arguments[1]]), arguments[2]
        if numbers.dtype == types.float32:
            builder.store(value, place)
            return None
        bits = builder.bitcast(value, _WORD)  # to the nearest, and of two to the even one
        odd = builder.and_(builder.lshr(bits, _WORD(16)), _WORD(1))
        rounded = builder.add(builder.add(bits, _WORD(0x7FFF)), odd)
        builder.store(builder.trunc(builder.lshr(rounded, _WORD(16)), ir.IntType(16)), place)
        return None

    return types.void(numbers, index, types.float32), code


_WORD, _FLOAT = ir.IntType(32), ir.FloatType()

# In kernels:
take: Any = intrinsic(_take)  # (given): the first row of a block, which no other thread gets
integers: Any = intrinsic(_pointer(types.int64))  # (address): the numbers there
floats: Any = intrinsic(_pointer(types.float32))
bfloats: Any = intrinsic(_pointer(types.uint16))  # bfloat16, for `load` and `store`
load: Any = intrinsic(_load)  # (floats or bfloats, index): float32
store: Any = intrinsic(_store)  # (floats or bfloats, index, float32)


@njit(cache=True)
def _probe():
    return 0


discard_stale_kernels(_probe, [Path(__file__)])  # that are compiled from the above, too
