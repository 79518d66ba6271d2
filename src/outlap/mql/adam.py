"""Adam for many small parameters, with clipping: on a CPU two kernels go through all of them at once."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import cfunc
from torch import Tensor, nn

from outlap.mql.torch_threads import BLOCK, ROW_LOOP, floats, integers, row_loop, take

CHUNK = 512  # numbers of a parameter that are one row of a kernel's loop
NOT_IN_KERNELS = ("weight_decay", "amsgrad", "maximize")  # options of PyTorch's Adam


class Adam(torch.optim.Adam):
    """Adam (Kingma & Ba, 2015) as PyTorch's, with the same state, whose gradients can be clipped on the way."""

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float) -> None:
        super().__init__(parameters, lr=lr, fused=True)

    @torch.no_grad()
    def step_clipped(self, max_norm: float) -> Tensor:
        """Change the parameters by their gradients, scaled together to a norm of at most `max_norm`.

        Kernels do it for float32 on a CPU, PyTorch elsewhere. Whether `grad` itself is scaled is left open.

        Returns:
            The norm before. One that is nan goes to all parameters.
        """
        (group,) = self.param_groups
        parameters = [p for p in group["params"] if p.grad is not None]
        tensors = [self._for_kernels(p) for p in parameters]
        if not tensors or not all(tensors) or any(group[option] for option in NOT_IN_KERNELS):
            norm = nn.utils.clip_grad_norm_(parameters, max_norm)
            self.step()
            return norm
        sizes = [p.numel() for p in parameters]
        # A row of each parameter: its size, and the addresses of itself, gradient, moments and steps.
        table = np.array([(size, *[t.data_ptr() for t in row]) for size, row in zip(sizes, tensors, strict=True)])
        chunks, given = _chunks(tuple(sizes)), torch.from_numpy(table)
        beta1, beta2 = group["betas"]
        constants = torch.tensor([group["lr"], 1.0 - beta1, 1.0 - beta2, group["eps"]], dtype=torch.float32)
        corrected = constants.new_empty(len(table), 2)  # of each parameter: step size, and what √v is multiplied by
        squares = constants.new_empty(len(chunks))
        row_loop(_count_and_square, len(chunks), given, chunks, constants, corrected, squares)
        norm = math.sqrt(squares.sum(dtype=torch.float64))
        scale = constants.new_tensor([1.0 if norm <= max_norm else max_norm / norm])
        row_loop(_change, len(chunks), given, chunks, constants, corrected, scale)
        torch.autograd.graph.increment_version(parameters)
        return constants.new_tensor(norm)

    def _for_kernels(self, p: nn.Parameter) -> tuple[Tensor, ...]:
        """The parameter, its gradient, its two moments and its steps; none where the kernels cannot take them."""
        if not _plain(p, p.numel()):
            return ()
        state = self.state[p]
        if not state:
            step = torch.zeros((), dtype=torch.float32, device="cpu")
            state |= {"step": step, "exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
        assert p.grad is not None
        mean, square, steps = state["exp_avg"], state["exp_avg_sq"], state["step"]
        if not (_plain(mean, p.numel()) and _plain(square, p.numel()) and _plain(steps, 1)):
            return ()
        return p, p.grad.contiguous(), mean, square, steps


def _plain(tensor: Tensor, size: int) -> bool:
    return tensor.is_cpu and tensor.dtype == torch.float32 and tensor.is_contiguous() and tensor.numel() == size


@cache
def _chunks(sizes: tuple[int, ...]) -> Tensor:
    """int64 (chunks, 2): of each chunk of parameters of such sizes, the parameter and its first number there."""
    return torch.tensor([(k, first) for k, size in enumerate(sizes) for first in range(0, size, CHUNK)])


_block, _1, _double = np.uint64(BLOCK), np.float32(1), np.float64
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}


# The sum in any order, so that it is vectorised.
@cfunc(ROW_LOOP, **_OPTIONS, fastmath={"reassoc", "nsz", "contract"})
def _count_and_square(given):
    rows, table, chunks, constants = given[1], integers(given[2]), integers(given[3]), floats(given[4])
    corrected, squares = floats(given[5]), floats(given[6])
    rate, share1, share2 = _double(constants[0]), _double(constants[1]), _double(constants[2])
    at = take(given)
    while at < rows:
        for row in range(at, min(at + _block, rows)):
            k, first = chunks[2 * row], chunks[2 * row + 1]
            grad, total = floats(np.uint64(table[6 * k + 2])), np.float32(0)
            for j in range(first, min(first + CHUNK, table[6 * k])):
                total += grad[j] * grad[j]
            squares[row] = total
            if first == 0:
                steps = floats(np.uint64(table[6 * k + 5]))
                steps[0] += _1
                corrected[2 * k] = np.float32(rate / (1.0 - (1.0 - share1) ** steps[0]))
                corrected[2 * k + 1] = np.float32(1.0 / np.sqrt(1.0 - (1.0 - share2) ** steps[0]))
        at = take(given)


@cfunc(ROW_LOOP, **_OPTIONS)
def _change(given):
    rows, table, chunks, constants = given[1], integers(given[2]), integers(given[3]), floats(given[4])
    corrected, scale = floats(given[5]), floats(given[6])[0]
    share1, share2, eps = constants[1], constants[2], constants[3]
    at = take(given)
    while at < rows:
        for row in range(at, min(at + _block, rows)):
            k, first = chunks[2 * row], chunks[2 * row + 1]
            parameter, grad = floats(np.uint64(table[6 * k + 1])), floats(np.uint64(table[6 * k + 2]))
            mean, square = floats(np.uint64(table[6 * k + 3])), floats(np.uint64(table[6 * k + 4]))
            step_size, over_root = corrected[2 * k], corrected[2 * k + 1]
            for j in range(first, min(first + CHUNK, table[6 * k])):
                g = scale * grad[j]
                mean[j] += share1 * (g - mean[j])
                square[j] += share2 * (g * g - square[j])
                parameter[j] -= step_size * mean[j] / (np.sqrt(square[j]) * over_root + eps)
        at = take(given)
