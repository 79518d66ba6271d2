"""A straightforward update of the paper's architecture, turn about with that of the preset `paper`: a yardstick.

TD3 as it is mostly written, with the networks of the preset `paper`: the critics' step, and at every other update the
actor's, each with a forward pass and a gradient of its own that trains the context too; `torch.nn.GRU`, two critics one
after the other, windows gathered by NumPy for both ends of a transition. 540 beams, batch 256. Episodes have no ends
here, and the replay is 8,192 steps: both save it time.

    python benchmarks/straightforward.py
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from outlap.experiments.throughput import mql_with_replay

SIZES = {"scan": 540, "pose": 3, "vel": 3, "heading": 2}
ACTIONS, HISTORY, HIDDEN, BATCH, ROWS, UPDATES = 2, 10, 128, 256, 8192, 10
Observation = dict[str, Tensor]


def mlp(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers)


class Encoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        widths = {name: 128 if name == "scan" else 64 for name in SIZES}
        self.terms = nn.ModuleDict({name: mlp(size, widths[name], widths[name]) for name, size in SIZES.items()})
        self.size = sum(widths.values())

    def forward(self, seen: Observation) -> Tensor:
        return torch.cat([encoder(seen[name]) for name, encoder in self.terms.items()], -1)


class Actor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.head = nn.Sequential(mlp(self.encoder.size + HIDDEN, 256, 256), nn.Linear(256, ACTIONS), nn.Tanh())

    def forward(self, seen: Observation, context: Tensor) -> Tensor:
        return self.head(torch.cat([self.encoder(seen), context], -1))


class Critic(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        inputs = self.encoder.size + ACTIONS + HIDDEN
        self.heads = nn.ModuleList(nn.Sequential(mlp(inputs, 256, 256), nn.Linear(256, 1)) for _ in range(2))

    def forward(self, seen: Observation, action: Tensor, context: Tensor) -> list[Tensor]:
        x = torch.cat([self.encoder(seen), action, context], -1)
        return [head(x) for head in self.heads]

    def first(self, seen: Observation, action: Tensor, context: Tensor) -> Tensor:
        return self.heads[0](torch.cat([self.encoder(seen), action, context], -1))


class Learner:
    def __init__(self) -> None:
        self.context = nn.GRU(ACTIONS + 1 + sum(SIZES.values()), HIDDEN, num_layers=2)
        self.actor, self.critic = Actor(), Critic()
        self.actor_target, self.critic_target = copy.deepcopy(self.actor), copy.deepcopy(self.critic)
        self.actor_optimizer = torch.optim.Adam([*self.actor.parameters(), *self.context.parameters()])
        self.critic_optimizer = torch.optim.Adam([*self.critic.parameters(), *self.context.parameters()])
        self.rng = np.random.default_rng(0)
        self.replay = {
            name: self.rng.random((ROWS, size), np.float32)
            for name, size in {"action": ACTIONS, "reward": 1, **SIZES}.items()
        }

    def window(self, rows: np.ndarray) -> Tensor:
        """(HISTORY, n, inputs) that lead to some rows."""
        steps = rows + np.arange(1 - HISTORY, 1)[:, None]
        return torch.as_tensor(np.concatenate([column[steps] for column in self.replay.values()], -1))

    def update(self, *, update_actor: bool) -> None:
        rows = self.rng.integers(HISTORY, ROWS - 1, BATCH)
        now, later = ({name: torch.as_tensor(self.replay[name][at]) for name in SIZES} for at in (rows, rows + 1))
        action, reward = (torch.as_tensor(self.replay[name][rows + 1]) for name in ("action", "reward"))
        window, window_later = self.window(rows), self.window(rows + 1)
        with torch.no_grad():
            context_later = self.context(window_later)[1][-1]
            noise = (0.2 * torch.randn(BATCH, ACTIONS)).clamp(-0.5, 0.5)
            chosen = (self.actor_target(later, context_later) + noise).clamp(-1.0, 1.0)
            target = reward + 0.99 * torch.min(*self.critic_target(later, chosen, context_later))
        values = self.critic(now, action, self.context(window)[1][-1])
        self.descend(self.critic_optimizer, sum(functional.mse_loss(value, target) for value in values))
        if update_actor:
            context = self.context(window)[1][-1]
            chosen = self.actor(now, context)
            self.descend(self.actor_optimizer, -self.critic.first(now, chosen, context.detach()).mean())
            with torch.no_grad():
                for follower, leader in ((self.actor_target, self.actor), (self.critic_target, self.critic)):
                    for old, new in zip(follower.parameters(), leader.parameters(), strict=True):
                        old.lerp_(new, 0.005)

    def descend(self, optimizer: torch.optim.Optimizer, loss: Tensor | int) -> None:
        assert isinstance(loss, Tensor)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 10.0)
        optimizer.step()


def milliseconds(updates: Callable[[], None]) -> float:
    began = time.perf_counter()
    updates()
    return (time.perf_counter() - began) * 1e3 / UPDATES


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--turns", type=int, default=25, help=f"of {UPDATES} updates each")
    turns = parser.parse_args().turns
    torch.manual_seed(0)
    learner, model = Learner(), mql_with_replay("paper", SIZES["scan"], BATCH)

    def plain() -> None:
        for i in range(UPDATES):
            learner.update(update_actor=i % 2 == 1)

    def ours() -> None:
        model.train(UPDATES, BATCH)

    took = np.array([(milliseconds(plain), milliseconds(ours)) for _ in range(turns + 1)][1:])
    for name, ms in (("straightforward", took[:, 0]), ("paper", took[:, 1])):
        print(f"{name:16} {np.median(ms):6.1f} ms   {ms.min():.1f} … {ms.max():.1f}")
    ratio = took[:, 0] / took[:, 1]
    print(f"{'ratio':16} {np.median(ratio):6.2f}      {ratio.min():.2f} … {ratio.max():.2f}")


if __name__ == "__main__":
    main()
