"""A GRU layer over a window, with its gradient written out: autograd, step by step, would take longer."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class GRULayer(torch.autograd.Function):
    """Cho et al. (2014), with the reset gate behind the recurrent product as in cuDNN and `torch.nn.GRU`.

    r, u = σ(x + W h + b)  ·  c = tanh(x + r (W h + b))  ·  h' = (1 - u) c + u h
    """

    @staticmethod
    def forward(ctx, projected: Tensor, valid: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """The hidden state after every step, from 0.

        Args:
            projected: (length, n, 3 hidden) the inputs' share of r, u and c.
            valid: (length, n, 1), 0 where the state is held at 0.
            weight: (3 hidden, hidden) and
            bias: (3 hidden,) of the recurrent product.

        Returns:
            (length, n, hidden).
        """
        length, n, hidden = projected.shape[0], projected.shape[1], weight.shape[1]
        gates = projected.new_empty(length, n, 2 * hidden)
        candidates = projected.new_empty(length, n, hidden)
        recalled = projected.new_empty(length, n, hidden)  # the recurrent product's share of c
        states = projected.new_zeros(length + 1, n, hidden)
        transposed = weight.t()
        for t in range(length):
            product = torch.addmm(bias, states[t], transposed)
            torch.add(projected[t, :, : 2 * hidden], product[:, : 2 * hidden], out=gates[t]).sigmoid_()
            recalled[t] = product[:, 2 * hidden :]
            reset, update = gates[t, :, :hidden], gates[t, :, hidden:]
            torch.addcmul(projected[t, :, 2 * hidden :], reset, recalled[t], out=candidates[t]).tanh_()
            torch.lerp(candidates[t], states[t], update, out=states[t + 1]).mul_(valid[t])
        ctx.save_for_backward(gates, candidates, recalled, states, valid, weight)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        gates, candidates, recalled, states, valid, weight = ctx.saved_tensors
        (grad_states,) = grads
        length, n, hidden = candidates.shape
        grad = gates.new_empty(length, n, 3 * hidden)  # of the pre-activations r, u, c, as the inputs see them
        reset, update = gates[..., :hidden], gates[..., hidden:]
        # What does not depend on the gradient that comes back through time is made for all steps at once.
        to_update = (states[:-1] - candidates) * update * (1.0 - update)
        to_candidate = (1.0 - update) * (1.0 - candidates.square())
        to_reset = recalled * reset * (1.0 - reset)
        back = torch.zeros_like(states[0])
        passed = gates.new_empty(n, 3 * hidden)
        for t in reversed(range(length)):
            back = (back + grad_states[t]).mul_(valid[t])
            here = grad[t]
            torch.mul(back, to_candidate[t], out=here[:, 2 * hidden :])
            torch.mul(back, to_update[t], out=here[:, hidden : 2 * hidden])
            torch.mul(here[:, 2 * hidden :], to_reset[t], out=here[:, :hidden])
            passed[:, : 2 * hidden] = here[:, : 2 * hidden]
            torch.mul(here[:, 2 * hidden :], reset[t], out=passed[:, 2 * hidden :])
            back = torch.addmm(back * update[t], passed, weight)
        recurrent = grad.clone()
        recurrent[..., 2 * hidden :] *= reset
        grad_weight = recurrent.reshape(-1, 3 * hidden).t() @ states[:-1].reshape(-1, hidden)
        return grad, None, grad_weight, recurrent.sum((0, 1))
