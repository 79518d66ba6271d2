"""A GRU layer over windows, with its gradient written out.

The matrix products are PyTorch's; all that stands between two of them is one pass over the data, in Numba. As
separate tensor operations those passes would take longer than the products.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable


def gru(projected: Tensor, valid: Tensor, first: Tensor, length: int, weight: Tensor, bias: Tensor) -> Tensor:
    """The hidden state after every step of each window, from 0: (length, n, hidden).

    r, u = σ(x + W h + b)  ·  c = tanh(x + r (W h + b))  ·  h' = c + u (h - c)

    Cho et al. (2014), with the reset gate behind the recurrent product as in cuDNN and `torch.nn.GRU`.

    Args:
        projected: (rows, n, 3 hidden) the inputs' share x of r, u and c.
        valid: (rows, n), 0 where the state is held at 0.
        first: int64 (n,) the row where each window begins.
        length: rows of a window.
        weight: (3 hidden, hidden) and
        bias: (3 hidden,) of the recurrent product.
    """
    if projected.device.type == "cpu" and projected.dtype == torch.float32:
        given = projected.contiguous(), valid.contiguous(), first, length, weight, bias
        states = GRULayer.apply(*given, torch.is_grad_enabled())
        assert isinstance(states, Tensor)
        return states
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
    """`gru` for float32 on a CPU; `projected` and `valid` are contiguous."""

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
        gates = projected.new_empty(kept, n, 3 * hidden)  # r, u and the recurrent product's share of c
        candidates = projected.new_empty(kept, n, hidden)
        states = projected.new_zeros(length + 1, n, hidden)
        transposed = weight.t()
        given = _flat(projected.detach(), valid, first, states)
        for t in range(length):
            here = gates[t % kept]
            torch.addmm(bias, states[t], transposed, out=here)
            _step(_u8(t), _u8(n), _u8(hidden), *given, *_flat(here, candidates[t % kept]))
        if with_grad:
            ctx.save_for_backward(projected, valid, first, gates, candidates, states, weight)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        projected, valid, first, gates, candidates, states, weight = ctx.saved_tensors
        (grad_states,) = grads
        length, n, hidden = grad_states.shape
        grad = torch.zeros_like(projected)
        recurrent = torch.empty_like(gates)  # the gradient of the recurrent products
        back = torch.zeros_like(states[0])
        given = _flat(valid, first, gates, candidates, states, grad_states.contiguous(), back, grad, recurrent)
        for t in reversed(range(length)):
            _step_back(_u8(t), _u8(n), _u8(hidden), *given)
            back.addmm_(recurrent[t], weight)
        flat = recurrent.view(-1, 3 * hidden)
        return grad, None, None, None, flat.t() @ states[:-1].view(-1, hidden), flat.sum(0), None


def _flat(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.view(-1).numpy() for tensor in tensors]


_f4, _u8 = np.float32, np.uint64
_2, _3 = _u8(2), _u8(3)


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _step(t, n, hidden, projected, valid, first, states, gates, candidates):
    """Everything of step `t` behind its product, which is in `gates`.

    It is vectorised because the arrays are flat, few to a loop, and all whole numbers unsigned.
    """
    for i in range(n):
        row = n * (_u8(first[i]) + t) + i
        x, g, c, h = _3 * hidden * row, _3 * hidden * i, hidden * i, hidden * (n * t + i)
        for j in range(_2 * hidden):
            gates[g + j] = _f4(0.5) + _f4(0.5) * _tanh(_f4(0.5) * (projected[x + j] + gates[g + j]))
        u, p, x, after, keep = g + hidden, g + _2 * hidden, x + _2 * hidden, h + n * hidden, valid[row]
        for j in range(hidden):
            candidates[c + j] = _tanh(projected[x + j] + gates[g + j] * gates[p + j])
        for j in range(hidden):
            states[after + j] = gates[u + j] * (states[h + j] - candidates[c + j])
        for j in range(hidden):
            states[after + j] = keep * (candidates[c + j] + states[after + j])


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _step_back(t, n, hidden, valid, first, gates, candidates, states, arrived, back, grad, recurrent):
    """The gradient of step `t` in front of its product; `back` becomes what passes it by, without the product."""
    for i in range(n):
        row, here = n * (_u8(first[i]) + t) + i, n * t + i
        b, h, r, to_r = hidden * i, hidden * here, _3 * hidden * here, _3 * hidden * row
        u, p, to_u, to_c, keep = r + hidden, r + _2 * hidden, to_r + hidden, to_r + _2 * hidden, valid[row]
        for j in range(hidden):
            back[b + j] = keep * (back[b + j] + arrived[h + j])
        for j in range(hidden):
            grad[to_c + j] = back[b + j] * (_f4(1) - candidates[h + j] * candidates[h + j])
        for j in range(hidden):
            grad[to_u + j] = back[b + j] * (states[h + j] - candidates[h + j])
        for j in range(hidden):
            grad[to_u + j] *= gates[u + j] * (_f4(1) - gates[u + j])
            grad[to_c + j] *= _f4(1) - gates[u + j]
            back[b + j] *= gates[u + j]
        for j in range(hidden):
            recurrent[p + j] = grad[to_c + j] * gates[r + j]
            grad[to_r + j] = grad[to_c + j] * gates[p + j] * gates[r + j] * (_f4(1) - gates[r + j])
        for j in range(_2 * hidden):
            recurrent[r + j] = grad[to_r + j]
