"""The networks of Meta-Q-Learning. A preset is one class; another one is one class more, named in `PRESETS`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import gymnasium as gym
import torch
from torch import Tensor, nn
from torch.nn import functional

PREVIOUS_REWARD = "previous_reward"  # the observation term that the context takes the reward from


def windows_from(rows: Tensor, first: Tensor, length: int) -> Tensor:
    """Return `length` rows of each of n sequences, beginning where each says; past the last row comes the first.

    Args:
        rows: (any number, n, ...).
        first: int64 (n,).
        length: of the windows.
    """
    number, n = rows.shape[:2]
    taken = (first + torch.arange(length, device=first.device)[:, None]) % number
    index = taken * n + torch.arange(n, device=first.device)
    return rows.flatten(0, 1).index_select(0, index.flatten()).unflatten(0, (length, n))


class GRUContext(nn.Module):
    """A GRU over a window of (action, reward, observation); before an episode's start its state stays 0."""

    def __init__(self, inputs: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.inputs, self.hidden = inputs, hidden
        self.gru = nn.GRU(inputs, hidden, layers)

    def forward(self, steps: Tensor, valid: Tensor) -> Tensor:
        """Return the context z (n, hidden): the last layer's state after the last step.

        The windows are shifted to begin with the episode. A state does not depend on the steps after it, so what is
        behind the last step does no harm.

        Args:
            steps: (length, n, inputs).
            valid: bool (length, n), False before the episode's start.
        """
        known = valid.sum(0)
        states, _ = self.gru(windows_from(steps, len(steps) - known, len(steps)))
        last = windows_from(states, (known - 1).clamp(min=0), 1)[0]
        return last * (known > 0)[:, None]


class WindowContext(nn.Module):
    """A perceptron over all steps of a window side by side."""

    def __init__(self, inputs: int, hidden: int, length: int) -> None:
        super().__init__()
        self.inputs, self.hidden = inputs, hidden
        self.layers = nn.Sequential(*_mlp(length * (inputs + 1), (128,), hidden), nn.Tanh())

    def forward(self, steps: Tensor, valid: Tensor) -> Tensor:
        """Return the context z (n, hidden) of windows: see `GRUContext`. Steps that are not valid count as zeros."""
        present = valid[..., None].to(steps.dtype)
        return self.layers(torch.cat([steps * present, present], -1).transpose(0, 1).flatten(1))


class ObservationEncoder(nn.Module):
    """One encoder a term, side by side."""

    def __init__(self, encoders: Mapping[str, nn.Module]) -> None:
        super().__init__()
        self.encoders = nn.ModuleDict(encoders)

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """(n, size) of each term → (n, sum of the encoders' sizes)."""
        return torch.cat([encoder(observation[name]) for name, encoder in self.encoders.items()], -1)


class ScanConvolution(nn.Module):
    """A 1-D convolution whose stride is its width, then one layer: (n, beams) → (n, size).

    Without overlap it is one matrix product over groups of neighbouring beams, and the scan need not be copied.
    """

    width, channels = 9, 32

    def __init__(self, beams: int, size: int) -> None:
        super().__init__()
        self.missing = -beams % self.width  # beams to fill up to whole groups
        self.groups = nn.Linear(self.width, self.channels)
        self.last = nn.Linear((beams + self.missing) // self.width * self.channels, size)

    def forward(self, scan: Tensor) -> Tensor:
        if self.missing:
            scan = functional.pad(scan, (0, self.missing))
        groups = torch.relu_(self.groups(scan.reshape(-1, self.width)))
        return torch.relu_(self.last(groups.view(-1, self.last.in_features)))


class TwinMLP(nn.Module):
    """Two networks of one shape side by side, as one batched product: (n, inputs) → (2, n).

    For the actor, which climbs the first one: (1, n), without gradient for the parameters.
    """

    def __init__(self, inputs: int, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        sizes = [inputs, *hidden, 1]
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(2, a, b)) for a, b in pairwise(sizes))
        self.biases = nn.ParameterList(nn.Parameter(torch.empty(2, 1, b)) for b in sizes[1:])
        self.layer_norm = layer_norm
        for a, weight, bias in zip(sizes, self.weights, self.biases, strict=False):
            nn.init.uniform_(weight, -1.0 / math.sqrt(a), 1.0 / math.sqrt(a))
            nn.init.uniform_(bias, -1.0 / math.sqrt(a), 1.0 / math.sqrt(a))

    def forward(self, x: Tensor, for_actor: bool = False) -> Tensor:
        weights, biases = (
            [p.detach()[:1] for p in ps] if for_actor else list(ps) for ps in (self.weights, self.biases)
        )
        x = x.expand(len(weights[0]), *x.shape)
        last = len(weights) - 1
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if i < last:
                if self.layer_norm:
                    x = functional.layer_norm(x, x.shape[-1:])
                x = torch.relu_(x)
        return x.squeeze(-1)


class Actor(nn.Module):
    """What it sees and the context → an action in [-1, 1]."""

    def __init__(self, encoder: ObservationEncoder, head: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = head

    def forward(self, embedding: Tensor, context: Tensor) -> Tensor:
        return torch.tanh(self.head(torch.cat([embedding, context], -1)))


class Critic(nn.Module):
    """What it sees, an action and the context → two estimates of the return, (2, n); for the actor see `TwinMLP`."""

    def __init__(self, encoder: ObservationEncoder, heads: TwinMLP) -> None:
        super().__init__()
        self.encoder = encoder
        self.heads = heads

    def forward(self, embedding: Tensor, action: Tensor, context: Tensor, for_actor: bool = False) -> Tensor:
        return self.heads(torch.cat([embedding, action, context], -1), for_actor)


class Preset:
    """How the networks are built; the class attributes are what presets differ in."""

    history = 10  # steps that the context is made of
    hidden: tuple[int, ...] = (256, 256)  # of actor and critics
    layer_norm = False  # in the critics
    shared_encoder = False  # actor, critics and context see through one encoder, which the critics' loss trains

    def context(self, inputs: int, history: int) -> GRUContext | WindowContext:
        """Return the context encoder for windows of `history` steps of `inputs` numbers."""
        return GRUContext(inputs, hidden=128, layers=2)

    def context_terms(self, space: gym.spaces.Dict) -> tuple[str, ...]:
        """The observation terms that the context is made of, PREVIOUS_REWARD aside."""
        return tuple(name for name in space.spaces if name != PREVIOUS_REWARD)

    def term_encoder(self, name: str, size: int) -> tuple[nn.Module, int]:
        """The encoder of a term of `size` numbers, and how many numbers it gives."""
        width = 128 if name == "scan" else 64
        return nn.Sequential(*_mlp(size, [width], width), nn.ReLU(inplace=True)), width

    def build(
        self, space: gym.spaces.Dict, actions: int, uses_reward: bool, history: int
    ) -> tuple[GRUContext | WindowContext, Actor, Critic]:
        """Return the networks for observations of `space`, which hold PREVIOUS_REWARD for the context alone."""
        sizes = {name: int(box.shape[0]) for name, box in space.spaces.items()}  # type: ignore[index]

        def encoder() -> tuple[ObservationEncoder, dict[str, int]]:
            built = {name: self.term_encoder(name, size) for name, size in sizes.items() if name != PREVIOUS_REWARD}
            widths = {name: width for name, (_, width) in built.items()}
            return ObservationEncoder({name: module for name, (module, _) in built.items()}), widths

        critic_encoder, widths = encoder()
        actor_encoder = critic_encoder if self.shared_encoder else encoder()[0]
        of_term = widths if self.shared_encoder else sizes
        step = actions + int(uses_reward) + sum(of_term[name] for name in self.context_terms(space))
        context = self.context(step, history)
        seen = sum(widths.values()) + context.hidden
        actor = Actor(actor_encoder, _mlp(seen, self.hidden, actions))
        critic = Critic(critic_encoder, TwinMLP(seen + actions, self.hidden, self.layer_norm))
        return context, actor, critic


class Paper(Preset):
    """The networks of the paper: its GRU reads whole observations as they are."""


class Fast(Preset):
    """For two cores: scans by convolution, a perceptron over a window of embedded proprioception, LayerNorm critics.

    What tells one vehicle from another is in a few numbers: how it moved and steered. Scans stay out of the context.
    """

    hidden = (128, 128)
    layer_norm = True
    shared_encoder = True

    def context_terms(self, space: gym.spaces.Dict) -> tuple[str, ...]:
        """All but scan and pose, unless there is nothing else."""
        names = super().context_terms(space)
        return tuple(name for name in names if name not in ("scan", "pose")) or names

    def context(self, inputs: int, history: int) -> GRUContext | WindowContext:
        return WindowContext(inputs, hidden=32, length=history)

    def term_encoder(self, name: str, size: int) -> tuple[nn.Module, int]:
        if name == "scan" and size >= 16:
            return ScanConvolution(size, 64), 64
        width = 64 if name == "scan" else 16
        return nn.Sequential(*_mlp(size, [], width), nn.ReLU(inplace=True)), width


PRESETS: dict[str, type[Preset]] = {"paper": Paper, "fast": Fast}


def _mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    sizes = [inputs, *hidden]
    layers: list[nn.Module] = []
    for a, b in pairwise(sizes):
        layers += [nn.Linear(a, b), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))
