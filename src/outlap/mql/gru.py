"""A stack of GRU layers over windows, with its gradient written out.

On a CPU a thread takes some windows through all their steps and layers, so that what it works on stays in its cache:
one kernel forwards, one back. The products of the first layer's inputs and of the weights' gradients are PyTorch's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import cfunc, njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from outlap.mql.lanes import LANES, clip, load, product, splat, store
from outlap.mql.torch_threads import BLOCK, ROW_LOOP, blocks_of, floats, integers, row_loop, take


class Layer(NamedTuple):
    """What makes V x + a of a layer's inputs x, and W h + b of its state h; their rows are those of r, u and c."""

    input_weight: Tensor  # (3 hidden, inputs) V
    input_bias: Tensor  # (3 hidden,) a
    weight: Tensor  # (3 hidden, hidden) W
    bias: Tensor  # (3 hidden,) b


def gru(
    steps: Tensor,
    valid: Tensor,
    length: int,
    layers: Sequence[Layer],
    later: Tensor | None = None,
    *,
    in_bfloat16: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """The last layer's state after a window's last step, from 0; and that of a later window, without gradient.

    r, u = σ(V x + a + W h + b)  ·  c = tanh(V x + a + r (W h + b))  ·  h' = c + u (h - c)

    Cho et al. (2014), with the reset gate behind the recurrent product as in cuDNN and `torch.nn.GRU`. Both windows
    share V x of the first layer, most of the work. On a CPU, in float32 and for hidden sizes that are a multiple of
    2 · LANES, kernels do it; otherwise PyTorch's operations.

    Args:
        steps: (rows, n, inputs) x of the first layer; that of the others is the state of the layer before.
        valid: (rows, n), 0 where the states are held at 0.
        length: rows of a window; the one with a gradient begins at row 0.
        layers: of one hidden size.
        later: int64 (n,) the row where the later window begins; by default there is none.
        in_bfloat16: make the first layer's V x, and its gradients, in bfloat16.

    Returns:
        (n, hidden) of the window; and of the later one, None where there is none.

    Raises ValueError where shapes do not fit, or a window leaves the rows.
    """
    rows, n, inputs = steps.shape
    hidden = layers[0].weight.shape[1]
    fit = 0 < length <= rows and valid.shape == (rows, n) and (later is None or later.shape == (n,))
    for i, layer in enumerate(layers):
        shapes = [(3 * hidden, hidden if i else inputs), (3 * hidden,), (3 * hidden, hidden), (3 * hidden,)]
        fit = fit and [tensor.shape for tensor in layer] == shapes
    on_cpu = steps.device.type == "cpu"
    if fit and on_cpu and later is not None and n:  # elsewhere it is not worth waiting for
        first, last = later.aminmax()
        fit = int(first) >= 0 and int(last) + length <= rows
    if not fit:
        raise ValueError(f"windows of {length} rows do not fit {tuple(steps.shape)}, or weights or masks do not")
    weights = [tensor for layer in layers for tensor in layer]
    if on_cpu and hidden % (2 * LANES) == 0 and all(tensor.dtype == torch.float32 for tensor in (steps, *weights)):
        keeps = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (steps, *weights))
        return GRUFunction.apply(steps, valid, length, later, in_bfloat16, keeps, *weights)  # type: ignore[return-value]
    _, projected = _project(steps, layers[0].input_weight, in_bfloat16)
    first = torch.zeros(n, dtype=torch.int64, device=steps.device)
    state = _gru_of_operations(projected, valid, length, first, layers)
    with torch.no_grad():
        return state, None if later is None else _gru_of_operations(projected, valid, length, later, layers)


def _project(x: Tensor, weight: Tensor, in_bfloat16: bool) -> tuple[Tensor, Tensor]:
    """x as it is multiplied, and V x."""
    if not in_bfloat16:
        return x, x @ weight.t()
    x = x.bfloat16()
    return x, (x @ weight.bfloat16().t()).float()


def _gru_of_operations(projected: Tensor, valid: Tensor, length: int, first: Tensor, layers: Sequence[Layer]) -> Tensor:
    """The state of the window of `gru` that begins at `first`, of PyTorch's operations."""
    each = torch.arange(len(first), device=first.device)
    states = [projected.new_zeros(len(first), layer.weight.shape[1]) for layer in layers]
    for t in range(length):
        of_input = projected[first + t, each]
        for i, (input_weight, input_bias, weight, bias) in enumerate(layers):
            if i:
                of_input = states[i - 1] @ input_weight.t()
            reset_x, update_x, candidate_x = (of_input + input_bias).chunk(3, -1)
            reset_h, update_h, candidate_h = torch.addmm(bias, states[i], weight.t()).chunk(3, -1)
            update = torch.sigmoid(update_x + update_h)
            candidate = torch.tanh(candidate_x + torch.sigmoid(reset_x + reset_h) * candidate_h)
            states[i] = valid[first + t, each].unsqueeze(-1) * torch.lerp(candidate, states[i], update)
    return states[-1]


class GRUFunction(torch.autograd.Function):
    """`gru` by kernels.

    A layer's gates, (length · n, 4 hidden), are at each step c, r, u and W h + b of c, in this order. Of what they are
    made of, the gradients lie in the same order: the first three are those of V x, the last three those of W h.
    """

    @staticmethod
    def forward(
        ctx,
        steps: Tensor,
        valid: Tensor,
        length: int,
        later: Tensor | None,
        in_bfloat16: bool,
        keeps: bool,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor | None]:
        """See `gru`; `keeps`: what `backward` needs."""
        n, hidden, layers = steps.shape[1], weights[2].shape[1], _layers(weights)
        valid = valid.float().contiguous()
        x, projected = _project(steps.flatten(0, 1), weights[0], in_bfloat16)
        packed = [
            (_biases(layer), _for_gates(_candidate_first(layer.input_weight)) if i else 0, _for_gates(layer.weight))
            for i, layer in enumerate(layers)
        ]

        def run(first: Tensor, kept: int) -> list[tuple[Tensor, Tensor]]:
            """The gates and states of every layer, at so many steps; at 0 the last ones."""
            made = [
                (valid.new_empty(max(kept, 1) * n, 4 * hidden), valid.new_empty((kept + 1) * n, hidden)) for _ in layers
            ]
            each = [number for pack, pair in zip(packed, made, strict=True) for number in (*pack, *pair)]
            row_loop(_forwards, n, hidden, length, len(layers), int(kept > 0), valid, first, projected, *each)
            return made

        kept = length if keeps else 0
        made = run(torch.zeros(n, dtype=torch.int64), kept)
        if keeps:
            ctx.save_for_backward(valid, x, *weights, *(tensor for pair in made for tensor in pair))
            ctx.shape, ctx.length = steps.shape, length
        arrived = None if later is None else run(later.long().contiguous(), 0)[-1][1]
        if arrived is not None:
            ctx.mark_non_differentiable(arrived)
        return made[-1][1][kept * n :].clone(), arrived

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor):
        valid, x, *rest = ctx.saved_tensors
        number, length, (rows, n, inputs) = len(rest) // 6, ctx.length, ctx.shape
        weights, made = rest[: 4 * number], rest[4 * number :]
        layers, hidden = _layers(weights), weights[2].shape[1]
        back = valid.new_zeros(number, n, hidden)  # what arrives from behind
        back[-1] = grads[0]
        of_sums = valid.new_empty(number, length * n, 4 * hidden)
        of_biases = valid.new_zeros(number, blocks_of(n), 4 * hidden)
        given: list[Tensor | int] = []
        for i, layer in enumerate(layers):
            given += [
                _for_inputs(_candidate_first(layer.input_weight)) if i else 0, _for_inputs(layer.weight),
                *made[2 * i : 2 * i + 2], of_sums[i], back[i], of_biases[i],
            ]  # fmt: skip
        row_loop(_backwards, n, hidden, length, number, valid, *given)
        found: list[Tensor | None] = []
        of_inputs = x[: length * n]
        for i, states in enumerate(made[1::2]):
            of_x, of_h = of_sums[i, :, : 3 * hidden], of_sums[i, n:, hidden:]
            of_input_weight = (of_inputs.t() @ of_x.to(of_inputs.dtype)).t().roll(-hidden, 0).float()
            sums = of_biases[i].sum(0)
            found += [of_input_weight, sums[: 3 * hidden].roll(-hidden)]
            found += [of_h.t() @ states[n : length * n], sums[hidden:]]
            of_inputs = states[n:]
        of_steps = None
        if ctx.needs_input_grad[0]:
            of_x = of_sums[0, :, : 3 * hidden].to(x.dtype)
            of_steps = x.new_empty(rows, n, inputs)
            of_steps[length:] = 0.0
            torch.mm(of_x, _candidate_first(weights[0]).to(x.dtype), out=of_steps[:length].view(-1, inputs))
            of_steps = of_steps.float()
        return of_steps, None, None, None, None, None, *found


def _layers(weights: Sequence[Tensor]) -> list[Layer]:
    return [Layer(*weights[k : k + 4]) for k in range(0, len(weights), 4)]


def _biases(layer: Layer) -> Tensor:
    """(4 hidden,) of the gates."""
    hidden = layer.weight.shape[1]
    x, h = (bias.split([2 * hidden, hidden]) for bias in (layer.input_bias, layer.bias))
    return torch.cat([x[1], x[0] + h[0], h[1]])


def _candidate_first(weight: Tensor) -> Tensor:
    """Rows of c, r and u in place of r, u and c."""
    return weight.roll(len(weight) // 3, 0)


def _for_gates(weight: Tensor) -> Tensor:
    """(3 hidden, inputs) as `_add_to_gates` reads it: in a panel a register's rows of each of the three parts."""
    return weight.reshape(3, -1, LANES, weight.shape[1]).permute(1, 3, 0, 2).contiguous()


def _for_inputs(weight: Tensor) -> Tensor:
    """(3 hidden, inputs) as `_add_to_inputs` reads it: in a panel two registers' columns."""
    return weight.reshape(len(weight), -1, 2 * LANES).transpose(0, 1).contiguous()


_f4, _u8 = np.float32, np.uint64
_0, _1, _2, _3, _4, _5, _6, _7 = map(_u8, range(8))
_lanes, _block = _u8(LANES), _u8(BLOCK)
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}

_add_to_gates, _add_to_inputs = product(3), product(2)


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
    n, hidden, length, layers, keeps = given[1], given[2], given[3], given[4], given[5]
    valid, first, projected = floats(given[6]), integers(given[7]), floats(given[8])
    width, zero = _4 * hidden, splat(_f4(0))
    kept = n * keeps  # rows from one step to the next, of which none or all are kept
    begin = take(given)
    while begin < n:
        rows = min(_block, n - begin)
        for t in range(length):
            at, before = width * (kept * t + begin), hidden * (kept * t + begin)
            after = before + hidden * kept
            for layer in range(layers):
                k = _u8(9) + _5 * layer
                # of a layer: biases, V and W packed, gates, states
                biases, gates, states = floats(given[k]), floats(given[k + _3]), floats(given[k + _4])
                for i in range(rows):  # in each place what is there of the sums
                    to = at + width * i
                    for j in range(_0, _4 * hidden, _lanes):
                        store(gates, to + j, load(biases, j))
                    if layer == _0:
                        x = _3 * hidden * (n * (_u8(first[begin + i]) + t) + begin + i)
                        for j in range(_0, hidden, _lanes):
                            c, r, u = to + j, to + hidden + j, to + _2 * hidden + j
                            store(gates, r, load(gates, r) + load(projected, x + j))
                            store(gates, u, load(gates, u) + load(projected, x + hidden + j))
                            store(gates, c, load(gates, c) + load(projected, x + _2 * hidden + j))
                if layer > _0:
                    below, weight = floats(given[k - _1]), floats(given[k + _1])
                    _add_to_gates(
                        rows, below, after, hidden, weight, hidden, hidden // _lanes, gates, at, width, hidden, _lanes
                    )
                if t > _0:  # before, the state is 0
                    weight, to = floats(given[k + _2]), at + hidden
                    _add_to_gates(
                        rows, states, before, hidden, weight, hidden, hidden // _lanes, gates, to, width, hidden, _lanes
                    )
                for i in range(rows):
                    keep = splat(valid[n * (_u8(first[begin + i]) + t) + begin + i])
                    for j in range(_0, hidden, _lanes):
                        c, h = at + width * i + j, hidden * i + j
                        r, u, s = c + hidden, c + _2 * hidden, c + _3 * hidden
                        reset, update = _sigmoid(load(gates, r)), _sigmoid(load(gates, u))
                        candidate = _tanh(load(gates, c) + reset * load(gates, s))
                        state = load(states, before + h) if t > _0 else zero
                        store(gates, c, candidate)
                        store(gates, r, reset)
                        store(gates, u, update)
                        store(states, after + h, keep * (candidate + update * (state - candidate)))
        begin = take(given)


@cfunc(ROW_LOOP, **_OPTIONS)
def _backwards(given):
    n, hidden, length, layers, valid = given[1], given[2], given[3], given[4], floats(given[5])
    width, zero, one, pair = _4 * hidden, splat(_f4(0)), splat(_f4(1)), _2 * _lanes
    panels = hidden // pair
    begin = take(given)
    while begin < n:
        rows, here = min(_block, n - begin), hidden * begin
        for step in range(length):
            t = length - _1 - step
            at = width * (n * t + begin)
            for down in range(layers):
                layer = layers - _1 - down
                # of a layer: V and W packed, gates, states, then gradients: of the gates' sums, the state, the biases
                k = _6 + _7 * layer
                gates, states, of_sums = floats(given[k + _2]), floats(given[k + _3]), floats(given[k + _4])
                back, of_biases = floats(given[k + _5]), floats(given[k + _6])
                total = _4 * hidden * (begin // _block)
                for i in range(rows):
                    keep = splat(valid[n * t + begin + i])
                    for j in range(_0, hidden, _lanes):
                        c, b = at + width * i + j, here + hidden * i + j
                        r, u, s = c + hidden, c + _2 * hidden, c + _3 * hidden
                        candidate, reset, update = load(gates, c), load(gates, r), load(gates, u)
                        of_state = keep * load(back, b)
                        of_candidate = of_state * (one - update) * (one - candidate * candidate)
                        state = load(states, hidden * n * t + b) if t > _0 else zero
                        of_update = of_state * (state - candidate) * update * (one - update)
                        of_share = of_candidate * reset
                        of_reset = of_share * load(gates, s) * (one - reset)
                        store(back, b, of_state * update)
                        store(of_sums, c, of_candidate)
                        store(of_sums, r, of_reset)
                        store(of_sums, u, of_update)
                        store(of_sums, s, of_share)
                        q = total + j
                        store(of_biases, q, load(of_biases, q) + of_candidate)
                        store(of_biases, q + hidden, load(of_biases, q + hidden) + of_reset)
                        store(of_biases, q + _2 * hidden, load(of_biases, q + _2 * hidden) + of_update)
                        store(of_biases, q + _3 * hidden, load(of_biases, q + _3 * hidden) + of_share)
                if t > _0:
                    weight = floats(given[k + _1])
                    _add_to_inputs(
                        rows, of_sums, at + hidden, width, weight, _3 * hidden, panels, back, here, hidden, _lanes, pair
                    )
                if layer > _0:
                    weight, below = floats(given[k]), floats(given[k - _2])  # the state's gradient
                    _add_to_inputs(
                        rows, of_sums, at, width, weight, _3 * hidden, panels, below, here, hidden, _lanes, pair
                    )
        begin = take(given)
