"""A GRU layer over windows, with its gradient written out.

On a CPU a thread takes some windows through all their steps, so that what it works on stays in its cache: one kernel
forwards, one back. Only the product that is the weights' gradient is PyTorch's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import cfunc, njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from outlap.mql.lanes import LANES, ROWS, clip, load, product, splat, store
from outlap.mql.torch_threads import BLOCK, ROW_LOOP, blocks_of, floats, integers, row_loop, take


def gru(
    projected: Tensor, valid: Tensor, first: Tensor, length: int, input_bias: Tensor, weight: Tensor, bias: Tensor
) -> Tensor:
    """The hidden state after every step of each window, from 0: (length, n, hidden).

    r, u = σ(x + W h + b)  ·  c = tanh(x + r (W h + b))  ·  h' = c + u (h - c)

    Cho et al. (2014), with the reset gate behind the recurrent product as in cuDNN and `torch.nn.GRU`.

    Args:
        projected: (rows, n, 3 hidden) and
        input_bias: (3 hidden,), together the inputs' share x of r, u and c.
        valid: (rows, n), 0 where the state is held at 0.
        first: int64 (n,) the row where each window begins.
        length: rows of a window.
        weight: (3 hidden, hidden) W and
        bias: (3 hidden,) b of the recurrent product.

    Raises ValueError where shapes do not fit, or a window leaves the rows.
    """
    rows, n, width = projected.shape
    fit = width == len(weight) == len(bias) == len(input_bias) == 3 * weight.shape[1] and valid.shape == (rows, n)
    fit = fit and first.shape == (n,)
    on_cpu = projected.device.type == "cpu"  # elsewhere PyTorch looks at the range itself
    if not fit or (on_cpu and not ((first >= 0) & (first + length <= rows)).all()):
        raise ValueError(f"windows of {length} rows do not fit {tuple(projected.shape)}, or weights or masks do not")
    if on_cpu and projected.dtype == weight.dtype == torch.float32 and weight.shape[1] % (2 * LANES) == 0:
        given = projected.contiguous(), valid.float().contiguous(), first.long().contiguous(), length
        states = GRULayer.apply(*given, input_bias, weight, bias, torch.is_grad_enabled())
        assert isinstance(states, Tensor)
        return states
    return _gru_of_operations(projected, valid, first, length, input_bias, weight, bias)


def _gru_of_operations(
    projected: Tensor, valid: Tensor, first: Tensor, length: int, input_bias: Tensor, weight: Tensor, bias: Tensor
) -> Tensor:
    """`gru` of PyTorch's operations alone: for other devices, types of number and sizes."""
    hidden, each = weight.shape[1], torch.arange(projected.shape[1], device=projected.device)
    state = projected.new_zeros(projected.shape[1], hidden)
    states = []
    for t in range(length):
        x = projected[first + t, each] + input_bias
        of_state = torch.addmm(bias, state, weight.t())
        gates = torch.sigmoid(x[:, : 2 * hidden] + of_state[:, : 2 * hidden])
        reset, update = gates.chunk(2, -1)
        candidate = torch.tanh(x[:, 2 * hidden :] + reset * of_state[:, 2 * hidden :])
        state = valid[first + t, each].unsqueeze(-1) * torch.lerp(candidate, state, update)
        states.append(state)
    return torch.stack(states)


class GRULayer(torch.autograd.Function):
    """`gru` on a CPU, in float32, for hidden states that fill registers."""

    @staticmethod
    def forward(
        ctx,
        projected: Tensor,
        valid: Tensor,
        first: Tensor,
        length: int,
        input_bias: Tensor,
        weight: Tensor,
        bias: Tensor,
        with_grad: bool,
    ) -> Tensor:
        """See `gru`; `with_grad`: keep what `backward` needs."""
        n, hidden = projected.shape[1], weight.shape[1]
        kept = length if with_grad else 1
        gates = valid.new_empty(kept, n, 3 * hidden)  # r, u and the recurrent product's share of c
        candidates = valid.new_empty(kept, n, hidden)
        states = valid.new_empty(length + 1, n, hidden)
        states[0] = 0.0
        both = torch.cat([input_bias[: 2 * hidden] + bias[: 2 * hidden], input_bias[2 * hidden :], bias[2 * hidden :]])
        # Columns of r, u and c that one step of the kernel's product makes, side by side.
        packed = weight.view(3, -1, LANES, hidden).permute(1, 3, 0, 2).contiguous()
        row_loop(
            _forwards, n, hidden, length, kept, valid, first, projected, both, packed, gates, candidates, states
        )  # fmt: skip
        if with_grad:
            ctx.save_for_backward(projected, valid, first, gates, candidates, states, weight)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        projected, valid, first, gates, candidates, states, weight = ctx.saved_tensors
        arrived = grads[0].contiguous()
        length, n, hidden = arrived.shape
        grad = torch.empty_like(projected)
        spare = len(projected) - length  # rows at either end that are not in every window
        for outside in (grad[:spare], grad[length:]):
            outside.zero_()
        recurrent = grad.new_empty(length, n, 3 * hidden)  # the gradient of the recurrent products
        back = grad.new_zeros(n, hidden)  # what arrives from the step behind
        of_biases = grad.new_zeros(blocks_of(n), 4 * hidden)
        packed = weight.view(3 * hidden, -1, 2 * LANES).transpose(0, 1).contiguous()
        row_loop(
            _backwards, n, hidden, length, valid, first, gates, candidates, states, packed, arrived, back, grad,
            recurrent, of_biases,
        )  # fmt: skip
        of_weight = recurrent[1:].view(-1, 3 * hidden).t() @ states[1:-1].view(-1, hidden)
        of_both, of_input, of_recurrent = of_biases.sum(0).split([2 * hidden, hidden, hidden])
        of_input, of_recurrent = torch.cat([of_both, of_input]), torch.cat([of_both, of_recurrent])
        return grad, None, None, None, of_input, of_weight, of_recurrent, None


_f4, _u8 = np.float32, np.uint64
_0, _1, _2, _3, _4 = _u8(0), _u8(1), _u8(2), _u8(3), _u8(4)
_lanes, _rows = _u8(LANES), _u8(ROWS)
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}

_gates_of_rows, _gates_of_row = (product(rows, 3, adds=False) for rows in (ROWS, 1))
_back_of_rows, _back_of_row = (product(rows, 2, adds=True) for rows in (ROWS, 1))


@njit(**_OPTIONS)
def _tanh(x):
    """Lambert's continued fraction to its seventh term at x / 2, and tanh 2y = 2 tanh y / (1 + tanh² y): to 1e-7.

    Only products and one quotient, of all lanes at once; the library's tanh takes them one by one.
    """
    y = clip(splat(_f4(0.5)) * x, splat(_f4(-5)), splat(_f4(5)))
    s = y * y
    a = y * (splat(_f4(135135)) + s * (splat(_f4(17325)) + s * (splat(_f4(378)) + s)))
    b = splat(_f4(135135)) + s * (splat(_f4(62370)) + s * (splat(_f4(3150)) + splat(_f4(28)) * s))
    return splat(_f4(2)) * a * b / (a * a + b * b)


@njit(**_OPTIONS)
def _sigmoid(x):
    half = splat(_f4(0.5))
    return half + half * _tanh(half * x)


@cfunc(ROW_LOOP, **_OPTIONS)
def _forwards(given):
    n, hidden, length, kept = given[1], given[2], given[3], given[4]
    valid, first, projected = floats(given[5]), integers(given[6]), floats(given[7])
    bias, weight = floats(given[8]), floats(given[9])
    gates, candidates, states = floats(given[10]), floats(given[11]), floats(given[12])
    width = _3 * hidden
    begin = take(given)
    while begin < n:
        end = min(begin + _u8(BLOCK), n)
        for step in range(length):
            t = _u8(step)
            at = n * (t % kept)
            if t == _0:  # the state is 0
                for k in range(width * (at + begin), width * (at + end), _lanes):
                    store(gates, k, splat(_f4(0)))
            else:
                j = _0
                while j < hidden:
                    i = begin
                    while i < end:
                        h, g = hidden * (n * t + i), width * (at + i) + j
                        if i + _rows <= end:
                            _gates_of_rows(states, h, hidden, weight, width * j, hidden, gates, g, width, hidden)
                            i += _rows
                        else:
                            _gates_of_row(states, h, hidden, weight, width * j, hidden, gates, g, width, hidden)
                            i += _1
                    j += _lanes
            for i in range(begin, end):
                row = n * (_u8(first[i]) + t) + i
                keep = splat(valid[row])
                j = _0
                while j < hidden:
                    x, g, h = width * row + j, width * (at + i) + j, hidden * (n * t + i) + j
                    reset = _sigmoid(load(projected, x) + load(gates, g) + load(bias, j))
                    update = _sigmoid(load(projected, x + hidden) + load(gates, g + hidden) + load(bias, hidden + j))
                    share = load(gates, g + _2 * hidden) + load(bias, width + j)
                    of_input = load(projected, x + _2 * hidden) + load(bias, _2 * hidden + j)
                    candidate = _tanh(of_input + reset * share)
                    store(gates, g, reset)
                    store(gates, g + hidden, update)
                    store(gates, g + _2 * hidden, share)
                    store(candidates, hidden * (at + i) + j, candidate)
                    store(states, h + hidden * n, keep * (candidate + update * (load(states, h) - candidate)))
                    j += _lanes
        begin = take(given)


@cfunc(ROW_LOOP, **_OPTIONS)
def _backwards(given):
    n, hidden, length = given[1], given[2], given[3]
    valid, first, gates, candidates = floats(given[4]), integers(given[5]), floats(given[6]), floats(given[7])
    states, weight, arrived, back = floats(given[8]), floats(given[9]), floats(given[10]), floats(given[11])
    grad, recurrent, of_biases = floats(given[12]), floats(given[13]), floats(given[14])
    width, one = _3 * hidden, splat(_f4(1))
    begin = take(given)
    while begin < n:
        end = min(begin + _u8(BLOCK), n)
        total = _4 * hidden * (begin // _u8(BLOCK))
        for step in range(length):
            t = length - _1 - _u8(step)
            for i in range(begin, end):
                row = n * (_u8(first[i]) + t) + i
                keep = splat(valid[row])
                j = _0
                while j < hidden:
                    to, b, h = width * row + j, hidden * i + j, hidden * (n * t + i) + j
                    r = width * (n * t + i) + j
                    u, p = r + hidden, r + _2 * hidden
                    reset, update, candidate = load(gates, r), load(gates, u), load(candidates, h)
                    of_state = keep * (load(back, b) + load(arrived, h))
                    of_candidate = of_state * (one - update) * (one - candidate * candidate)
                    of_update = of_state * (load(states, h) - candidate) * update * (one - update)
                    of_share = of_candidate * reset
                    of_reset = of_share * load(gates, p) * (one - reset)
                    store(back, b, of_state * update)
                    store(grad, to, of_reset)
                    store(grad, to + hidden, of_update)
                    store(grad, to + _2 * hidden, of_candidate)
                    store(recurrent, r, of_reset)
                    store(recurrent, u, of_update)
                    store(recurrent, p, of_share)
                    s = total + j
                    store(of_biases, s, load(of_biases, s) + of_reset)
                    store(of_biases, s + hidden, load(of_biases, s + hidden) + of_update)
                    store(of_biases, s + _2 * hidden, load(of_biases, s + _2 * hidden) + of_candidate)
                    store(of_biases, s + width, load(of_biases, s + width) + of_share)
                    j += _lanes
            if t > _0:
                j = _0
                while j < hidden:
                    i = begin
                    while i < end:
                        r, b = width * (n * t + i), hidden * i + j
                        if i + _rows <= end:
                            _back_of_rows(recurrent, r, width, weight, width * j, width, back, b, hidden, _lanes)
                            i += _rows
                        else:
                            _back_of_row(recurrent, r, width, weight, width * j, width, back, b, hidden, _lanes)
                            i += _1
                    j += _2 * _lanes
        begin = take(given)
