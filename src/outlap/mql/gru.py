"""A GRU layer over windows, with its gradient written out.

The matrix products are PyTorch's; all that stands between two of them is one pass over the data, in Numba. As
separate tensor operations those passes would take longer than the products.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import cfunc, njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from outlap.mql.torch_threads import BLOCK, ROW_LOOP, RowLoop, bfloats, floats, integers, load, store, take


def gru(projected: Tensor, valid: Tensor, first: Tensor, length: int, weight: Tensor, bias: Tensor) -> Tensor:
    """The hidden state after every step of each window, from 0: (length, n, hidden).

    r, u = σ(x + W h + b)  ·  c = tanh(x + r (W h + b))  ·  h' = c + u (h - c)

    Cho et al. (2014), with the reset gate behind the recurrent product as in cuDNN and `torch.nn.GRU`.

    Args:
        projected: (rows, n, 3 hidden) the inputs' share x of r, u and c. In bfloat16 on a CPU, the products are made
            of factors rounded to that and are rounded so, and the states stay float32.
        valid: (rows, n), 0 where the state is held at 0.
        first: int64 (n,) the row where each window begins.
        length: rows of a window.
        weight: (3 hidden, hidden) and
        bias: (3 hidden,) of the recurrent product.

    Raises ValueError where shapes do not fit, or a window leaves the rows.
    """
    rows, n, width = projected.shape
    fit = width == len(weight) == len(bias) == 3 * weight.shape[1] and valid.shape == (rows, n) and first.shape == (n,)
    on_cpu = projected.device.type == "cpu"  # elsewhere PyTorch looks at the range itself
    if not fit or (on_cpu and not ((first >= 0) & (first + length <= rows)).all()):
        raise ValueError(f"windows of {length} rows do not fit {tuple(projected.shape)}, or weights or masks do not")
    if on_cpu and projected.dtype in _STEPS:
        given = projected.contiguous(), valid.float().contiguous(), first.long().contiguous(), length, weight
        states = GRULayer.apply(*given, bias.float().contiguous(), torch.is_grad_enabled())
        assert isinstance(states, Tensor)
        return states.to(weight.dtype)
    return _gru_of_operations(projected, valid, first, length, weight, bias)


def _gru_of_operations(
    projected: Tensor, valid: Tensor, first: Tensor, length: int, weight: Tensor, bias: Tensor
) -> Tensor:
    """`gru` of PyTorch's operations alone, for other devices and types of number."""
    hidden, each = weight.shape[1], torch.arange(projected.shape[1], device=projected.device)
    state = projected.new_zeros(projected.shape[1], hidden)
    states = []
    for t in range(length):
        x = projected[first + t, each]
        product = torch.addmm(bias, state, weight.t())
        gates = torch.sigmoid(x[:, : 2 * hidden] + product[:, : 2 * hidden])
        reset, update = gates.chunk(2, -1)
        candidate = torch.tanh(x[:, 2 * hidden :] + reset * product[:, 2 * hidden :])
        state = valid[first + t, each].unsqueeze(-1) * torch.lerp(candidate, state, update)
        states.append(state)
    return torch.stack(states)


class GRULayer(torch.autograd.Function):
    """`gru` on a CPU, for `projected` in float32 or bfloat16."""

    @staticmethod
    def forward(
        ctx,
        projected: Tensor,
        valid: Tensor,
        first: Tensor,
        length: int,
        weight: Tensor,
        bias: Tensor,
        with_grad: bool,
    ) -> Tensor:
        """See `gru`; `with_grad`: keep what `backward` needs."""
        n, hidden = projected.shape[1], weight.shape[1]
        kept = length if with_grad else 1
        gates = valid.new_empty(kept, n, 3 * hidden)  # r, u and the recurrent product's share of c
        candidates = valid.new_empty(kept, n, hidden)
        states = valid.new_zeros(length + 1, n, hidden)
        rounds = projected.dtype != states.dtype
        factors = states.to(projected.dtype) if rounds else states  # of products
        weight = weight.to(projected.dtype)
        transposed = weight.t()
        product = projected.new_empty(n, 3 * hidden) if rounds else gates  # in place where nothing is rounded
        step = RowLoop(
            _STEPS[projected.dtype], n, hidden, kept, valid, first, states, gates, candidates, bias,
            projected, product, factors,
        )  # fmt: skip
        for t in range(length):
            here = product if rounds else gates[t % kept]
            if t:
                torch.mm(factors[t], transposed, out=here)
            else:
                here.zero_()  # as the state is
            step(t)
        if with_grad:
            ctx.save_for_backward(projected, valid, first, gates, candidates, states, factors, weight)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        projected, valid, first, gates, candidates, states, factors, weight = ctx.saved_tensors
        arrived = grads[0].contiguous()
        length, n, hidden = arrived.shape
        grad = torch.empty_like(projected)
        spare = len(projected) - length  # rows at either end that are not in every window
        for outside in (grad[:spare], grad[length:]):
            outside.zero_()
        recurrent = grad.new_empty(length, n, 3 * hidden)  # the gradient of the recurrent products
        back = torch.zeros_like(arrived[0])
        rounds = projected.dtype != back.dtype
        product = grad.new_zeros(n, hidden) if rounds else back
        own = torch.empty_like(gates[0]) if rounds else grad
        step_back = RowLoop(
            _STEPS_BACK[projected.dtype], n, hidden, valid, first, gates, candidates, states, arrived, back,
            product, grad, recurrent, own,
        )  # fmt: skip
        for t in reversed(range(length)):
            step_back(t)
            if t and rounds:
                torch.mm(recurrent[t], weight, out=product)
            elif t:
                back.addmm_(recurrent[t], weight)
        of_weight = recurrent[1:].view(-1, 3 * hidden).t() @ factors[1:-1].view(-1, hidden)
        of_bias = recurrent.sum((0, 1), dtype=arrived.dtype)
        return grad, None, None, None, of_weight.to(arrived.dtype), of_bias, None


_f4, _u8 = np.float32, np.uint64
_2, _3 = _u8(2), _u8(3)
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**_OPTIONS)
def _tanh(x):
    """Lambert's continued fraction to its seventh term at x / 2, and tanh 2y = 2 tanh y / (1 + tanh² y): to 1e-7.

    Only products and one quotient, so that the lanes of a register compute 16 at a time; the library's tanh does not.
    """
    y = _f4(0.5) * x
    y = _f4(-5) if y < _f4(-5) else y  # in this order nan stays nan
    y = _f4(5) if y > _f4(5) else y
    s = y * y
    a = y * (_f4(135135) + s * (_f4(17325) + s * (_f4(378) + s)))
    b = _f4(135135) + s * (_f4(62370) + s * (_f4(3150) + _f4(28) * s))
    return _f4(2) * a * b / (a * a + b * b)


# Loops are vectorised because arrays are flat, few to a loop, and all whole numbers unsigned.


@njit(**_OPTIONS)
def _step(given, projected, product, factors):
    """Everything of a step behind its product; `factors` are the states as the next product reads them.

    Where nothing is rounded, both are none: the product is in `gates`, and the states are read as they are.
    """
    n, t, hidden, kept = given[1], given[2], given[3], given[4]
    valid, first, states = floats(given[5]), integers(given[6]), floats(given[7])
    gates, candidates, bias = floats(given[8]), floats(given[9]), floats(given[10])
    begin = take(given)
    while begin < n:
        for i in range(begin, min(begin + _u8(BLOCK), n)):
            row, here, at = n * (_u8(first[i]) + t) + i, n * t + i, n * (t % kept) + i
            x, m, h, keep = _3 * hidden * row, _3 * hidden * i, hidden * here, valid[row]
            g, c, after = _3 * hidden * at, hidden * at, h + n * hidden
            if product is not None:
                for j in range(_3 * hidden):
                    gates[g + j] = load(product, m + j)
            for j in range(_3 * hidden):
                gates[g + j] += bias[j]
            for j in range(_2 * hidden):
                gates[g + j] = _f4(0.5) + _f4(0.5) * _tanh(_f4(0.5) * (load(projected, x + j) + gates[g + j]))
            u, p, x = g + hidden, g + _2 * hidden, x + _2 * hidden
            for j in range(hidden):
                candidates[c + j] = _tanh(load(projected, x + j) + gates[g + j] * gates[p + j])
            for j in range(hidden):
                states[after + j] = gates[u + j] * (states[h + j] - candidates[c + j])
            for j in range(hidden):
                states[after + j] = keep * (candidates[c + j] + states[after + j])
            if factors is not None:
                for j in range(hidden):
                    store(factors, after + j, states[after + j])
        begin = take(given)


@njit(**_OPTIONS)
def _step_back(given, product, grad, own, recurrent):
    """The gradient of a step in front of its product; `back` becomes what passes it by, without the product.

    Where nothing is rounded, `product` and `grad` are none: the product is in `back`, and `own` is the gradient.
    """
    n, t, hidden = given[1], given[2], given[3]
    valid, first, gates, candidates = floats(given[4]), integers(given[5]), floats(given[6]), floats(given[7])
    states, arrived, back = floats(given[8]), floats(given[9]), floats(given[10])
    begin = take(given)
    while begin < n:
        for i in range(begin, min(begin + _u8(BLOCK), n)):
            row, here = n * (_u8(first[i]) + t) + i, n * t + i
            b, h, r, to, keep = hidden * i, hidden * here, _3 * hidden * here, _3 * hidden * row, valid[row]
            to_r = to if grad is None else _3 * hidden * i
            u, p, to_u, to_c = r + hidden, r + _2 * hidden, to_r + hidden, to_r + _2 * hidden
            if product is not None:
                for j in range(hidden):
                    back[b + j] += load(product, b + j)
            for j in range(hidden):
                back[b + j] = keep * (back[b + j] + arrived[h + j])
            for j in range(hidden):
                own[to_c + j] = back[b + j] * (_f4(1) - candidates[h + j] * candidates[h + j])
            for j in range(hidden):
                own[to_u + j] = back[b + j] * (states[h + j] - candidates[h + j])
            for j in range(hidden):
                own[to_u + j] *= gates[u + j] * (_f4(1) - gates[u + j])
                own[to_c + j] *= _f4(1) - gates[u + j]
                back[b + j] *= gates[u + j]
            for j in range(hidden):
                store(recurrent, p + j, own[to_c + j] * gates[r + j])
                own[to_r + j] = own[to_c + j] * gates[p + j] * gates[r + j] * (_f4(1) - gates[r + j])
            for j in range(_2 * hidden):
                store(recurrent, r + j, own[to_r + j])
            if grad is not None:
                for j in range(_3 * hidden):
                    store(grad, to + j, own[to_r + j])
        begin = take(given)


@cfunc(ROW_LOOP, **_OPTIONS)
def _step_float32(given):
    _step(given, floats(given[11]), None, None)


@cfunc(ROW_LOOP, **_OPTIONS)
def _step_bfloat16(given):
    _step(given, bfloats(given[11]), bfloats(given[12]), bfloats(given[13]))


@cfunc(ROW_LOOP, **_OPTIONS)
def _step_back_float32(given):
    _step_back(given, None, None, floats(given[14]), floats(given[13]))


@cfunc(ROW_LOOP, **_OPTIONS)
def _step_back_bfloat16(given):
    _step_back(given, bfloats(given[11]), bfloats(given[12]), floats(given[14]), bfloats(given[13]))


_STEPS = {torch.float32: _step_float32, torch.bfloat16: _step_bfloat16}
_STEPS_BACK = {torch.float32: _step_back_float32, torch.bfloat16: _step_back_bfloat16}
