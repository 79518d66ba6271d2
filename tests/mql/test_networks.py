"""The networks: the GRU against PyTorch's own, and what each part sees."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from outlap.mql.gru import GRULayer
from outlap.mql.networks import PRESETS, ContextEncoder, TwinMLP


def space(**sizes: int) -> gym.spaces.Dict:
    return gym.spaces.Dict({name: gym.spaces.Box(-1.0, 1.0, (size,), np.float32) for name, size in sizes.items()})


@pytest.mark.parametrize("layers", [1, 2])
def test_the_context_is_that_of_pytorchs_gru_and_so_is_its_gradient(layers: int) -> None:
    torch.manual_seed(0)
    ours = ContextEncoder(7, 5, layers).double()
    theirs = torch.nn.GRU(7, 5, layers, batch_first=True).double()
    pairs = []
    for i in range(layers):
        for kind, part in (("ih", ours.inputs[i]), ("hh", ours.recurrent[i])):
            pairs.append((part.weight, getattr(theirs, f"weight_{kind}_l{i}")))
            pairs.append((part.bias, getattr(theirs, f"bias_{kind}_l{i}")))
    for mine, other in pairs:
        other.data.copy_(mine.data)
    steps = torch.randn(4, 6, 7, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(4, 5, dtype=torch.float64)
    z = ours(ours.project(steps), torch.ones(4, 6, dtype=torch.float64))
    expected = theirs(steps)[1][-1]
    torch.testing.assert_close(z, expected)
    gradients = torch.autograd.grad((z * weight).sum(), [steps, *(mine for mine, _ in pairs)])
    wanted = torch.autograd.grad((expected * weight).sum(), [steps, *(other for _, other in pairs)])
    for got, want in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(got, want)


def test_the_gradient_is_that_of_finite_differences_where_steps_are_missing() -> None:
    torch.manual_seed(1)
    projected = torch.randn(5, 3, 6, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[0, 1, 1], [0, 1, 1], [1, 1, 0], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)[..., None]
    weight = torch.randn(6, 2, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, w, b: GRULayer.apply(p, valid, w, b), (projected, weight, bias))


def test_what_was_before_an_episode_changes_nothing() -> None:
    torch.manual_seed(2)
    encoder = ContextEncoder(3, 8, 2)
    steps = torch.randn(2, 6, 3)
    valid = torch.ones(2, 6)
    valid[:, :2] = 0.0
    z = encoder(encoder.project(steps), valid)
    torch.testing.assert_close(z, encoder(encoder.project(steps[:, 2:]), valid[:, 2:]))


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
