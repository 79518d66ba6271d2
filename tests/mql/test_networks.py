"""The networks: the GRU against its equations in NumPy, and what each part sees."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from outlap.mql.networks import PRESETS, GRUContext, ScanConvolution, TwinMLP, WindowContext, windows_from


def space(**sizes: int) -> gym.spaces.Dict:
    return gym.spaces.Dict({name: gym.spaces.Box(-1.0, 1.0, (size,), np.float32) for name, size in sizes.items()})


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def gru_step_by_step(gru: torch.nn.GRU, steps: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The last state (n, hidden): the equations of Cho et al. (2014), with the reset gate as in cuDNN.

    A state stays 0 at a step that is not valid.
    """
    weights = {name: parameter.detach().numpy().astype(np.float64) for name, parameter in gru.named_parameters()}
    inputs = steps.astype(np.float64)
    for layer in range(gru.num_layers):
        v, w, a, b = (weights[f"{kind}_l{layer}"] for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))
        state = np.zeros((steps.shape[1], gru.hidden_size))
        states = []
        for x, there in zip(inputs, valid, strict=True):
            reset_x, update_x, candidate_x = np.split(x @ v.T + a, 3, axis=-1)
            reset_h, update_h, candidate_h = np.split(state @ w.T + b, 3, axis=-1)
            update = sigmoid(update_x + update_h)
            candidate = np.tanh(candidate_x + sigmoid(reset_x + reset_h) * candidate_h)
            state = there[:, None] * ((1.0 - update) * candidate + update * state)
            states.append(state)
        inputs = np.stack(states)
    return inputs[-1]


def beginnings(length: int) -> torch.Tensor:
    """Validity (length, length + 1) of windows of every number of steps, 0 among them."""
    return torch.arange(length)[:, None] >= torch.arange(length + 1)


@pytest.mark.parametrize("layers", [1, 2, 3])
@pytest.mark.parametrize("length", [1, 6])
def test_the_gru_follows_its_equations_from_an_episodes_start(layers: int, length: int) -> None:
    torch.manual_seed(0)
    context, valid = GRUContext(7, 5, layers), beginnings(length)
    steps = torch.randn(*valid.shape, 7)
    expected = gru_step_by_step(context.gru, steps.numpy(), valid.numpy())
    torch.testing.assert_close(context(steps, valid), torch.from_numpy(expected).float(), atol=1e-6, rtol=1e-5)
    assert (context(steps, valid)[-1] == 0.0).all()  # of no step at all


@pytest.mark.parametrize("kind", [GRUContext, WindowContext])
def test_what_was_before_an_episode_changes_nothing(kind: type[GRUContext] | type[WindowContext]) -> None:
    torch.manual_seed(2)
    context, valid = kind(3, 8, 2 if kind is GRUContext else 6), beginnings(6)
    steps = torch.randn(*valid.shape, 3, requires_grad=True)
    other = torch.where(valid[..., None], steps, 100.0 * torch.randn_like(steps))
    z = context(steps, valid)
    torch.testing.assert_close(z, context(other, valid), atol=0.0, rtol=0.0)
    (gradient,) = torch.autograd.grad(z.square().sum(), steps)
    assert (gradient[~valid] == 0.0).all()
    assert (gradient[valid] != 0.0).any(-1).all()


def test_the_gru_computes_every_window_alike_wherever_it_is_in_a_batch() -> None:
    torch.manual_seed(3)
    context, valid = GRUContext(7, 32, 2), beginnings(5)
    steps = torch.randn(*valid.shape, 7)
    together = context(steps, valid)
    for i in range(valid.shape[1]):
        torch.testing.assert_close(context(steps[:, [i]], valid[:, [i]])[0], together[i])


def test_a_window_context_tells_a_step_of_zeros_from_none() -> None:
    torch.manual_seed(4)
    z = WindowContext(3, 8, 4)(torch.zeros(4, 5, 3), beginnings(4))
    assert len({tuple(row) for row in z.tolist()}) == 5


def test_windows_begin_where_each_says() -> None:
    rows = torch.arange(12).view(4, 3)
    assert windows_from(rows, torch.tensor([0, 1, 2]), 2).tolist() == [[0, 4, 8], [3, 7, 11]]
    assert windows_from(rows, torch.tensor([0, 3, 4]), 2).tolist() == [[0, 10, 2], [3, 1, 5]]  # round the end
    assert windows_from(rows[..., None], torch.tensor([2, 0, 1]), 1).tolist() == [[[6], [1], [5]]]


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
        space(scan=540, pose=3, vel=3, heading=2, previous_reward=1), actions=2, uses_reward=True, history=10
    )
    assert isinstance(context, GRUContext)
    shapes = {name: tuple(parameter.shape) for name, parameter in context.gru.named_parameters()}
    assert shapes["weight_ih_l0"] == (3 * 128, 2 + 1 + 540 + 3 + 3 + 2)
    assert shapes["weight_ih_l1"] == shapes["weight_hh_l0"] == shapes["weight_hh_l1"] == (3 * 128, 128)
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
