"""Registers of several floats in Numba kernels: what is written with them is vectorised, whatever a compiler sees.

`load`, `store`, `splat` and `clip`, the four operations between two `lanes`, and `product`, a small matrix product
whose sums stay in registers.
"""

from __future__ import annotations

import operator
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import njit
from numba.core import cgutils, config, types
from numba.core.datamodel.models import PrimitiveModel
from numba.extending import intrinsic, overload, register_model


def _register_file() -> tuple[int, int]:
    """Floats of a register, and rows of a `product` of which three registers each fit beside what they are made of."""
    given = getattr(config, "CPU_FEATURES")  # noqa: B009 - Numba sets it from NUMBA_CPU_FEATURES
    features = llvm.get_host_cpu_features() if given is None else dict.fromkeys(given.replace("+", "").split(","), True)
    avx = getattr(config, "ENABLE_AVX")  # noqa: B009
    if avx and features.get("avx512f"):
        return 16, 8  # of 32 registers
    return (8, 4) if avx and features.get("avx2") else (4, 4)  # of 16


LANES, ROWS = _register_file()


class Lanes(types.Type):
    """LANES float32 numbers."""

    def __init__(self) -> None:
        super().__init__("lanes")


lanes = Lanes()
_FLOAT, _INDEX = ir.FloatType(), ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_POINTER, _UNSIGNED = types.CPointer(types.float32), types.uint64


@register_model(Lanes)
class LanesModel(PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _at(builder, pointer, index):
    return builder.bitcast(builder.gep(pointer, [index]), _VECTOR.as_pointer())


def _read(builder, pointer, index):
    return builder.load(_at(builder, pointer, index), align=4)


def _write(builder, value, pointer, index) -> None:
    builder.store(value, _at(builder, pointer, index), align=4)


def _spread(builder, number):
    none, first = ir.Constant(_VECTOR, ir.Undefined), ir.IntType(32)(0)
    one = builder.insert_element(none, number, first)
    return builder.shuffle_vector(one, none, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _load(typingctx, pointer, index):
    return lanes(_POINTER, _UNSIGNED), lambda context, builder, signature, given: _read(builder, *given)


def _store(typingctx, pointer, index, value):
    def code(context, builder, signature, given):
        _write(builder, given[2], given[0], given[1])

    return types.void(_POINTER, _UNSIGNED, lanes), code


def _splat(typingctx, number):
    return lanes(types.float32), lambda context, builder, signature, given: _spread(builder, given[0])


def _clip(typingctx, value, low, high):
    def code(context, builder, signature, given):
        value, low, high = given
        value = builder.select(builder.fcmp_ordered("<", value, low), low, value)  # in this order nan stays nan
        return builder.select(builder.fcmp_ordered(">", value, high), high, value)

    return lanes(lanes, lanes, lanes), code


load: Any = intrinsic(_load)  # (float pointer, index): lanes from there on
store: Any = intrinsic(_store)  # (float pointer, index, lanes)
splat: Any = intrinsic(_splat)  # (float32): lanes of it
clip: Any = intrinsic(_clip)  # (lanes, low, high)


def _operation(function: Any, instruction: str) -> None:
    def apply(typingctx, left, right):
        def code(context, builder, signature, given):
            return getattr(builder, instruction)(*given, flags=("contract",))

        return lanes(lanes, lanes), code

    between: Any = intrinsic(apply)

    @overload(function)
    def of_lanes(left, right):
        if left is lanes and right is lanes:
            return lambda left, right: between(left, right)
        return None


for _function, _instruction in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
):  # fmt: skip
    _operation(_function, _instruction)


def product(registers: int) -> Any:
    """A kernel's function for C += A B, whose sums stay in so many registers of each of some rows.

    Called with (rows; a, its first number, its row's length; b, its height, its panels; c, its first number, its row's
    length, from one register's columns to the next, from one panel's to the next). A panel of B has the columns of
    `registers` registers side by side, row by row; panels lie one behind the other.
    """
    of_rows, of_row = (_tile(rows, registers) for rows in (ROWS, 1))
    together, one, size = np.uint64(ROWS), np.uint64(1), np.uint64(registers * LANES)

    @njit(error_model="numpy")
    def multiply(rows, a, a_first, a_row, b, height, panels, c, c_first, c_row, c_apart, c_next):
        for panel in range(panels):
            i, at = np.uint64(0), size * height * panel
            while i < rows:
                here, to = a_first + a_row * i, c_first + c_row * i + c_next * panel
                if i + together <= rows:
                    of_rows(a, here, a_row, b, at, height, c, to, c_row, c_apart)
                    i += together
                else:
                    of_row(a, here, a_row, b, at, height, c, to, c_row, c_apart)
                    i += one

    return multiply


def _tile(rows: int, registers: int) -> Any:
    """C += A B of so many rows and registers' columns, whose sums stay in registers."""

    def compute(typingctx, a, a_first, a_row, b, b_first, height, c, c_first, c_row, c_apart):
        def code(context, builder, signature, given):
            a, a_first, a_row, b, b_first, height, c, c_first, c_row, c_apart = given
            fma = cgutils.get_or_insert_function(  # in one where the processor can
                builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fmuladd.v{LANES}f32"
            )
            zero = ir.Constant(_VECTOR, [0.0] * LANES)
            sums = [[cgutils.alloca_once_value(builder, zero) for _ in range(registers)] for _ in range(rows)]
            row_at = [builder.add(a_first, builder.mul(a_row, _INDEX(row))) for row in range(rows)]
            with cgutils.for_range(builder, height) as loop:
                at = builder.add(b_first, builder.mul(loop.index, _INDEX(registers * LANES)))
                of_b = [_read(builder, b, builder.add(at, _INDEX(r * LANES))) for r in range(registers)]
                for row in range(rows):
                    of_a = builder.load(builder.gep(a, [builder.add(row_at[row], loop.index)]))
                    spread = _spread(builder, of_a)
                    for total, factor in zip(sums[row], of_b, strict=True):
                        builder.store(builder.call(fma, [spread, factor, builder.load(total)]), total)
            for row in range(rows):
                at = builder.add(c_first, builder.mul(c_row, _INDEX(row)))
                for total in sums[row]:
                    _write(builder, builder.fadd(builder.load(total), _read(builder, c, at)), c, at)
                    at = builder.add(at, c_apart)

        index = types.uint64
        return types.void(_POINTER, index, index, _POINTER, index, index, _POINTER, index, index, index), code

    return intrinsic(compute)
