"""The networks: the GRU against PyTorch's own, and what each part sees."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch

from outlap.mql.gru import Layer, gru
from outlap.mql.lanes import LANES
from outlap.mql.networks import PRESETS, ContextEncoder, ScanConvolution, TwinMLP


@pytest.fixture(autouse=True)
def _nan_where_nothing_was_written() -> Iterator[None]:
    """So that a kernel which reads there shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def space(**sizes: int) -> gym.spaces.Dict:
    return gym.spaces.Dict({name: gym.spaces.Box(-1.0, 1.0, (size,), np.float32) for name, size in sizes.items()})


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # kernels of our own, and operations of PyTorch
def test_the_context_is_that_of_pytorchs_gru_and_so_is_its_gradient(layers: int, dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    hidden = 2 * LANES  # what the kernels take
    ours = ContextEncoder(7, hidden, layers).to(dtype)
    theirs = torch.nn.GRU(7, hidden, layers).to(dtype)
    pairs = []
    for i in range(layers):
        for kind, part in (("ih", ours.inputs[i]), ("hh", ours.recurrent[i])):
            pairs.append((part.weight, getattr(theirs, f"weight_{kind}_l{i}")))
            pairs.append((part.bias, getattr(theirs, f"bias_{kind}_l{i}")))
    for mine, other in pairs:
        other.data.copy_(mine.data)
    steps = torch.randn(6, 4, 7, dtype=dtype, requires_grad=True)
    weight = torch.randn(4, hidden, dtype=dtype)
    z, _ = ours(steps, torch.ones(6, 4, dtype=dtype), 6)
    expected = theirs(steps)[1][-1]
    torch.testing.assert_close(z, expected)
    gradients = torch.autograd.grad((z * weight).sum(), [steps, *(mine for mine, _ in pairs)])
    wanted = torch.autograd.grad((expected * weight).sum(), [steps, *(other for _, other in pairs)])
    for got, want in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(got, want)


def layers_of(number: int, inputs: int, hidden: int) -> list[Layer]:
    layers = []
    for size in (inputs, *(number - 1) * [hidden]):
        shapes = (3 * hidden, size), (3 * hidden,), (3 * hidden, hidden), (3 * hidden,)
        layers.append(Layer(*((2.0 * torch.randn(s) / s[-1] ** 0.5).requires_grad_() for s in shapes)))
    return layers


def as_given(hidden: int) -> Layer:
    """A layer whose inputs are what its gates see, exactly, and whose state they do not see."""
    zero = torch.zeros(3 * hidden)
    return Layer(torch.eye(3 * hidden), zero, torch.zeros(3 * hidden, hidden), zero)


@pytest.mark.parametrize(("length", "number"), [(1, 1), (4, 1), (4, 2), (4, 3)])
@pytest.mark.parametrize(("n", "threads"), [(19, 1), (300, 2)])
def test_the_kernels_do_what_the_operations_do_where_windows_begin_and_episodes_too(
    length: int, number: int, n: int, threads: int, request: pytest.FixtureRequest
) -> None:
    request.addfinalizer(partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(threads)
    torch.manual_seed(1)
    hidden, rows, inputs = 6 * LANES, 6, 11
    steps = torch.randn(rows, n, inputs, requires_grad=True)
    valid = (torch.arange(rows)[:, None] >= torch.randint(0, 4, (n,))).float()
    later = torch.randint(0, rows - length + 1, (n,))
    layers = layers_of(number, inputs, hidden)
    upstream = torch.randn(n, hidden)
    found, found_later = gru(steps, valid, length, layers, later)
    wide = [Layer(*(tensor.detach().double().requires_grad_() for tensor in layer)) for layer in layers]
    wide_steps = steps.detach().double().requires_grad_()
    expected, expected_later = gru(wide_steps, valid.double(), length, wide, later)
    assert found_later is not None
    assert expected_later is not None
    assert not found_later.requires_grad
    assert not expected_later.requires_grad
    torch.testing.assert_close(found, expected.float(), atol=2e-6, rtol=0.0)
    torch.testing.assert_close(found_later, expected_later.float(), atol=2e-6, rtol=0.0)
    gradients = torch.autograd.grad((found * upstream).sum(), [steps, *(p for layer in layers for p in layer)])
    wanted = torch.autograd.grad(
        (expected * upstream.double()).sum(), [wide_steps, *(p for layer in wide for p in layer)]
    )
    for got, want in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(got, want.float(), atol=2e-6 * float(want.abs().max()), rtol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(gru(steps, valid, length, layers)[0], found, atol=0.0, rtol=0.0)


def test_the_kernels_compute_every_window_alike_wherever_it_is_in_a_batch() -> None:
    torch.manual_seed(3)
    hidden, rows, n = 2 * LANES, 5, 77  # some in groups, and some one by one
    layers = [as_given(hidden)._replace(weight=torch.randn(3 * hidden, hidden)), *layers_of(1, hidden, hidden)]
    steps, valid = torch.randn(rows, n, 3 * hidden), torch.ones(rows, n)
    together, _ = gru(steps, valid, rows, layers)
    for i in range(n):
        alone, _ = gru(steps[:, [i]], valid[:, [i]], rows, layers)
        torch.testing.assert_close(alone[0], together[i], atol=0.0, rtol=0.0)


def test_gradients_can_be_had_again_and_in_any_order() -> None:
    torch.manual_seed(6)
    layers, valid = layers_of(2, 4, 2 * LANES), torch.ones(3, 5)
    parameters = [parameter for layer in layers for parameter in layer]
    one, other = (gru(torch.randn(3, 5, 4), valid, 3, layers)[0].sum() for _ in range(2))
    first = torch.autograd.grad(one, parameters, retain_graph=True)
    torch.autograd.grad(other, parameters)
    for got, want in zip(torch.autograd.grad(one, parameters), first, strict=True):
        torch.testing.assert_close(got, want, atol=0.0, rtol=0.0)


def test_the_kernels_take_any_layout_and_any_number_of_windows() -> None:
    torch.manual_seed(7)
    hidden, n = 2 * LANES, 5
    layers = layers_of(2, 4, hidden)
    steps, valid, later = (
        torch.randn(n, 6, 4).transpose(0, 1),
        torch.rand(n, 6).t() < 0.7,
        torch.tensor([0, 1, 1, 0, 1]),
    )
    found = gru(steps, valid, 5, layers, later.int())
    expected = gru(steps.contiguous(), valid.float().contiguous(), 5, layers, later)
    torch.testing.assert_close(found, expected, atol=0.0, rtol=0.0)
    none, none_later = gru(steps[:, :0], valid[:, :0], 5, layers, later[:0])
    assert none_later is not None
    assert none.shape == none_later.shape == (0, hidden)
    assert not any(grad.any() for grad in torch.autograd.grad(none.sum(), layers[0]))


@pytest.mark.parametrize("half", range(8))
def test_weights_in_half_precision_are_not_misread(half: int) -> None:
    torch.manual_seed(8)
    weights = [parameter.detach() for layer in layers_of(2, 4, 2 * LANES) for parameter in layer]
    steps, valid = torch.randn(3, 5, 4), torch.ones(3, 5)
    expected, _ = gru(steps, valid, 3, [Layer(*weights[:4]), Layer(*weights[4:])])
    weights[half] = weights[half].half()
    try:
        found, _ = gru(steps, valid, 3, [Layer(*weights[:4]), Layer(*weights[4:])])
    except RuntimeError:  # PyTorch multiplies no two types of number
        return
    torch.testing.assert_close(found.float(), expected, atol=0.01, rtol=0.0)


@pytest.mark.parametrize("number", [1, 2])
def test_the_context_does_not_depend_on_the_types_of_what_is_given(number: int) -> None:
    torch.manual_seed(4)
    exact = ContextEncoder(7, 5, number)
    rounded = copy.deepcopy(exact).bfloat16()
    steps, valid, later = torch.randn(6, 4, 7), torch.ones(6, 4), torch.tensor([0, 1, 1, 0])
    exactly = exact(steps, valid, 5, later)
    for found, expected in zip(rounded(steps.bfloat16(), valid.bool(), 5, later.int()), exactly, strict=True):
        assert found.dtype == torch.bfloat16
        torch.testing.assert_close(found.float(), expected, atol=0.03, rtol=0.0)


@pytest.mark.parametrize(
    ("later", "length", "mask"),
    [([0, 2], 4, (5, 2)), ([-1, 0], 4, (5, 2)), ([0, 0], 6, (5, 2)), ([0, 0], 4, (1, 2)), ([0], 4, (5, 2))],
)
@pytest.mark.parametrize("hidden", [3, 2 * LANES])
def test_windows_that_leave_the_rows_are_refused(
    later: list[int], length: int, mask: tuple[int, int], hidden: int
) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        gru(torch.zeros(5, 2, 4), torch.ones(mask), length, layers_of(2, 4, hidden), torch.tensor(later))


@pytest.mark.parametrize("field", Layer._fields)
@pytest.mark.parametrize("which", [0, 1])
def test_weights_of_other_shapes_are_refused(which: int, field: str) -> None:
    layers = layers_of(2, 4, 2 * LANES)
    layers[which] = layers[which]._replace(**{field: torch.zeros(6 * LANES, 2 * LANES + 1)})
    with pytest.raises(ValueError, match="do not fit"):
        gru(torch.zeros(5, 2, 4), torch.ones(5, 2), 5, layers)


def test_gates_saturate_where_inputs_are_huge_and_hide_no_nan() -> None:
    inputs = torch.tensor([-1e30, -30.0, 0.0, 30.0, 1e30, float("nan")])
    hidden = 2 * LANES
    steps = inputs[None, :, None].expand(1, 6, 3 * hidden)
    z, _ = gru(steps, torch.ones(1, 6), 1, [as_given(hidden)])
    expected = torch.tensor([-1.0, -1.0, 0.0, 0.0, 0.0, float("nan")])[:, None].expand(6, hidden)
    torch.testing.assert_close(z, expected, atol=1e-7, rtol=0.0, equal_nan=True)


def test_what_was_before_an_episode_changes_nothing() -> None:
    torch.manual_seed(2)
    encoder = ContextEncoder(3, 8, 2)
    steps = torch.randn(6, 2, 3)
    valid = torch.ones(6, 2)
    valid[:2] = 0.0
    z, _ = encoder(steps, valid, 6)
    torch.testing.assert_close(z, encoder(steps[2:], valid[2:], 4)[0])


@pytest.mark.parametrize("hidden", [5, 2 * LANES])  # operations of PyTorch, and kernels
def test_in_bfloat16_the_context_and_its_gradient_are_nearly_the_same(hidden: int) -> None:
    torch.manual_seed(5)
    encoder = ContextEncoder(200, hidden, 2)
    steps, weight = torch.randn(8, 64, 200, requires_grad=True), torch.randn(64, hidden)
    found = []
    for encoder.in_bfloat16 in (False, True):
        z, _ = encoder(steps, torch.ones(8, 64), 8)
        assert z.dtype == torch.float32
        found.append((z, *torch.autograd.grad((z * weight).sum(), [steps, *encoder.parameters()])))
    for exact, rounded in zip(*found, strict=True):
        off = (exact - rounded).norm() / exact.norm()
        assert 0.0 < off < 0.02


def test_a_convolution_without_overlap_is_pytorchs() -> None:
    torch.manual_seed(4)
    ours = ScanConvolution(20, 6)  # 20 beams: 7 are missing to 27
    theirs = torch.nn.Conv1d(1, ours.channels, ours.width, stride=ours.width)
    theirs.weight.data.copy_(ours.groups.weight.data[:, None])
    assert theirs.bias is not None
    theirs.bias.data.copy_(ours.groups.bias.data)
    scan = torch.randn(3, 20)
    groups = torch.relu(theirs(torch.nn.functional.pad(scan, (0, 7))[:, None]))
    torch.testing.assert_close(ours(scan), torch.relu(ours.last(groups.transpose(1, 2).flatten(1))))


def test_twin_critics_are_two_networks_of_their_own() -> None:
    torch.manual_seed(3)
    twin = TwinMLP(4, (8, 8), layer_norm=False)
    x = torch.randn(5, 4)
    for which in range(2):
        y = x
        for i, (weight, bias) in enumerate(zip(twin.weights, twin.biases, strict=True)):
            y = y @ weight[which] + bias[which]
            y = torch.relu(y) if i < 2 else y
        torch.testing.assert_close(twin(x)[which], y[:, 0])
    assert not torch.allclose(twin(x)[0], twin(x)[1])


def test_the_papers_networks_have_the_papers_sizes() -> None:
    context, actor, critic = PRESETS["paper"]().build(
        space(scan=540, pose=3, vel=3, heading=2, previous_reward=1), actions=2, uses_reward=True
    )
    assert [layer.in_features for layer in context.inputs] == [2 + 1 + 540 + 3 + 3 + 2, 128]
    assert [layer.in_features for layer in context.recurrent] == [128, 128]
    for encoder in (actor.encoder, critic.encoder):
        widths = {
            name: [p.shape[0] for p in part.parameters() if p.ndim == 2] for name, part in encoder.encoders.items()
        }
        assert widths == {"scan": [128, 128], "pose": [64, 64], "vel": [64, 64], "heading": [64, 64]}
    assert actor.encoder is not critic.encoder


def test_the_fast_context_reads_no_scan_unless_there_is_nothing_else() -> None:
    fast = PRESETS["fast"]()
    assert fast.context_terms(space(scan=108, pose=3, vel=3, heading=2, previous_reward=1)) == (
        "heading",
        "vel",
    )  # as gymnasium sorts them
    assert fast.context_terms(space(scan=108, previous_reward=1)) == ("scan",)
