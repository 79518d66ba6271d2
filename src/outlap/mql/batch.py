"""What is read from a replay: windows of rows, and batches of transitions, as tensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Windows:
    """Sequences of rows, oldest first, as a network goes through them: step by step."""

    steps: Tensor  # float32 (length, n, columns): the action that led to each row, then each term asked for
    columns: dict[str, slice]  # of each term in `steps`
    valid: Tensor  # bool (length, n): False before an episode's start, where all else is 0

    @property
    def action(self) -> Tensor:
        """(length, n, actions) that led to each row; 0 at an episode's start."""
        ends = min((columns.start for columns in self.columns.values()), default=None)
        return self.steps[..., :ends]

    @property
    def observation(self) -> dict[str, Tensor]:
        """(length, n, size) of each term."""
        return {name: self.steps[..., columns] for name, columns in self.columns.items()}

    def first(self, rows: int) -> Windows:
        """Return the first `rows` rows of each window."""
        return Windows(self.steps[:rows], self.columns, self.valid[:rows])

    def to(self, device: torch.device) -> Windows:
        """Return the windows on a device."""
        return Windows(self.steps.to(device), self.columns, self.valid.to(device))


@dataclass(frozen=True)
class Batch:
    """Transitions of `steps` steps each, with the windows that belong to both of their ends."""

    serial: np.ndarray  # int64 (n,) of the rows that they depart from
    task: np.ndarray  # int64 (n,) positions in `ReplayBuffer.tasks`
    windows: Windows  # of history + n_steps rows: up to the departure, then onwards; the last row repeated at the end
    observation: dict[str, Tensor]  # float32 (n, size) of every term, at the departure
    next_observation: dict[str, Tensor]  # (n, size) at the arrival
    action: Tensor  # float32 (n, actions) taken at the departure
    reward: Tensor  # float32 (n,) discounted sum over the steps
    discount: Tensor  # float32 (n,) of the arrival's value: γ^steps, 0 where the episode terminated there
    steps: Tensor  # int64 (n,) 1 … n_steps; fewer at the end of an episode

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device."""
        if device.type == "cpu":
            return self
        return replace(
            self,
            windows=self.windows.to(device),
            observation={name: term.to(device) for name, term in self.observation.items()},
            next_observation={name: term.to(device) for name, term in self.next_observation.items()},
            **{name: getattr(self, name).to(device) for name in ("action", "reward", "discount", "steps")},
        )
