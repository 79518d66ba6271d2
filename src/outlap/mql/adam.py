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


class Adam(torch.optim.Adam):
    """Adam (Kingma & Ba, 2015) as PyTorch's, with the same state, whose gradients can be clipped on the way."""

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float) -> None:
        super().__init__(parameters, lr=lr, fused=True)

    @torch.no_grad()
    def step_clipped(self, max_norm: float) -> Tensor:
        """Change the parameters by their gradients, which are scaled together to a norm of at most `max_norm`.

        Returns:
            The norm before. One that is nan goes to all parameters.
        """
        (group,) = self.param_groups
        parameters = [p for p in group["params"] if p.grad is not None]
        by_kernels = all(p.device.type == "cpu" and p.dtype == torch.float32 and p.is_contiguous() for p in parameters)
        if not parameters or not by_kernels:
            norm = nn.utils.clip_grad_norm_(parameters, max_norm)
            self.step()
            return norm
        parts, kept = [], []
        for p in parameters:
            state, grad = self.state[p], p.grad.contiguous()  # type: ignore[union-attr]
            if not state:
                state |= {"step": torch.zeros(()), "exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            tensors = p, grad, state["exp_avg"], state["exp_avg_sq"], state["step"]
            parts.append((p.numel(), *[tensor.data_ptr() for tensor in tensors]))
            kept.append(grad)  # until the kernels have read it
        of_parts, chunks = torch.from_numpy(np.array(parts)), _chunks(tuple(part[0] for part in parts))
        constants = torch.tensor([*group["betas"], group["lr"], group["eps"], 1.0])
        squares, corrections = torch.empty(len(chunks)), torch.empty(len(parts), 2)
        row_loop(_square, len(chunks), of_parts, chunks, constants, squares, corrections)
        norm = math.sqrt(squares.sum(dtype=torch.float64))
        if not norm <= max_norm:
            constants[-1] = max_norm / norm
        row_loop(_change, len(chunks), of_parts, chunks, constants, corrections)
        return torch.tensor(norm)


@cache
def _chunks(sizes: tuple[int, ...]) -> Tensor:
    """int64 (chunks, 2): the part, and its first number, of each piece of parts of such sizes."""
    return torch.tensor([(part, first) for part, size in enumerate(sizes) for first in range(0, size, CHUNK)])


_block = np.uint64(BLOCK)
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}


@cfunc(ROW_LOOP, **_OPTIONS, fastmath={"reassoc", "nsz", "contract"})
def _square(given):
    rows, parts, chunks, constants = given[1], integers(given[2]), integers(given[3]), floats(given[4])
    squares, corrections = floats(given[5]), floats(given[6])
    beta1, beta2, rate = np.float64(constants[0]), np.float64(constants[1]), np.float64(constants[2])
    at = take(given)
    while at < rows:
        for row in range(at, min(at + _block, rows)):
            number, first = chunks[2 * row], chunks[2 * row + 1]
            part = 6 * number  # of a part: size, parameter, gradient, its mean, its square's mean, steps
            grad = floats(np.uint64(parts[part + 2]))
            total = np.float32(0)
            for j in range(first, min(first + CHUNK, parts[part])):
                total += grad[j] * grad[j]
            squares[row] = total
            if first == 0:
                steps = floats(np.uint64(parts[part + 5]))
                steps[0] += np.float32(1)
                corrections[2 * number] = np.float32(rate / (1.0 - beta1 ** steps[0]))
                corrections[2 * number + 1] = np.float32(1.0 / np.sqrt(1.0 - beta2 ** steps[0]))
        at = take(given)


@cfunc(ROW_LOOP, **_OPTIONS)
def _change(given):
    rows, parts, chunks, constants = given[1], integers(given[2]), integers(given[3]), floats(given[4])
    corrections = floats(given[5])
    beta1, beta2, eps, scale = constants[0], constants[1], constants[3], constants[4]
    one = np.float32(1)
    at = take(given)
    while at < rows:
        for row in range(at, min(at + _block, rows)):
            number, first = chunks[2 * row], chunks[2 * row + 1]
            part = 6 * number
            parameter, grad = floats(np.uint64(parts[part + 1])), floats(np.uint64(parts[part + 2]))
            mean, square = floats(np.uint64(parts[part + 3])), floats(np.uint64(parts[part + 4]))
            size, root = corrections[2 * number], corrections[2 * number + 1]
            for j in range(first, min(first + CHUNK, parts[part])):
                g = scale * grad[j]
                mean[j] += (one - beta1) * (g - mean[j])
                square[j] = beta2 * square[j] + (one - beta2) * g * g
                parameter[j] -= size * mean[j] / (np.sqrt(square[j]) * root + eps)
        at = take(given)
