"""Trained perceptrons as data: policies that are loaded without running code, and many of them asked as one batch."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from outlap.drivers.driver import Driver, DriverStack
from outlap.errors import OutlapError, brief
from outlap.files import atomic_write, to_json

if TYPE_CHECKING:
    from stable_baselines3 import PPO

ACTIVATIONS = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, 0.0)}
# Cars of a driver in one matrix product, padded where there are fewer: a product rounds differently with the number of
# its rows, and a car's action must not depend on the cars beside it.
ROWS = 16
MOST_WEIGHTS = 1 << 24  # of a file that is loaded: 64 MB


@dataclass(frozen=True, eq=False, kw_only=True)
class MLPDriver(Driver):
    """Drives with a perceptron over observation terms, side by side in the order of their names."""

    name: str
    sizes: Mapping[str, int]  # of each term that it sees
    scale_observations: bool = False
    speeds: tuple[float, float]  # pyright: ignore[reportIncompatibleVariableOverride]  # always known
    activation: str  # between layers
    bounded: bool = False  # whether a tanh follows the last layer; its actions are clipped to [-1, 1] otherwise
    weights: tuple[np.ndarray, ...]  # float32 (inputs, outputs) of each layer
    biases: tuple[np.ndarray, ...]  # float32 (outputs,)

    observation_terms: tuple[str, ...] = field(init=False)
    beams: int | None = field(init=False)
    architecture: Hashable = field(init=False)

    def __post_init__(self) -> None:
        shapes = tuple(weight.shape for weight in self.weights)
        architecture = tuple(sorted(self.sizes.items())), self.scale_observations, self.activation, self.bounded, shapes
        object.__setattr__(self, "observation_terms", tuple(sorted(self.sizes)))
        object.__setattr__(self, "beams", self.sizes.get("scan"))
        object.__setattr__(self, "architecture", architecture)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`."""
        return MLPStack([self]).act(np.zeros(len(observation[self.observation_terms[0]]), np.int64), observation)

    @classmethod
    def stack(cls, drivers: Sequence[MLPDriver]) -> MLPStack:
        """See `Driver.stack`."""
        return MLPStack(drivers)

    @classmethod
    def from_ppo(cls, model: PPO, name: str, scale_observations: bool, speeds: tuple[float, float]) -> MLPDriver:
        """The mean action of a Stable-Baselines3 PPO policy with a Dict observation and no shared layers."""
        import torch

        from outlap.drivers.bounded_policy import BoundedLinear

        policy = model.policy
        layers = [*policy.mlp_extractor.policy_net, policy.action_net]
        linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
        between = {type(layer) for layer in layers if not isinstance(layer, torch.nn.Linear)}
        names = {torch.nn.Tanh: "tanh", torch.nn.ReLU: "relu"}
        if len(between) != 1 or not between <= set(names):
            raise OutlapError(f"{name}: has layers {sorted(kind.__name__ for kind in between)}; must be Tanh or ReLU")
        sizes = {term: int(box.shape[0]) for term, box in model.observation_space.spaces.items()}  # type: ignore[attr-defined]
        return cls(
            name=name,
            sizes=sizes,
            scale_observations=scale_observations,
            speeds=speeds,
            activation=names[between.pop()],
            bounded=isinstance(policy.action_net, BoundedLinear),
            weights=tuple(layer.weight.detach().cpu().numpy().T.copy() for layer in linear),
            biases=tuple(layer.bias.detach().cpu().numpy().copy() for layer in linear),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write PATH.safetensors with the weights and PATH.json with all else."""
        from safetensors.numpy import save

        path = Path(path)
        tensors = {f"weight_{i}": np.ascontiguousarray(weight) for i, weight in enumerate(self.weights)}
        tensors |= {f"bias_{i}": bias for i, bias in enumerate(self.biases)}
        facts = {
            "name": self.name,
            "sizes": dict(self.sizes),
            "scale_observations": self.scale_observations,
            "speeds": list(self.speeds),
            "activation": self.activation,
            "bounded": self.bounded,
            "layers": len(self.weights),
        }
        atomic_write(path.with_name(f"{path.name}.safetensors"), save(tensors))
        atomic_write(path.with_name(f"{path.name}.json"), to_json(facts))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MLPDriver:
        """Read what `save` wrote; runs no code from the files.

        Raises OutlapError for files that are missing, broken, or of layers that do not fit together.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load

        path = Path(path)
        try:
            facts = json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8"))
            content = path.with_name(f"{path.name}.safetensors").read_bytes()
            if len(content) > 4 * MOST_WEIGHTS:
                raise OutlapError(f"{path}: holds {len(content)} bytes of weights; must be at most {4 * MOST_WEIGHTS}")
            tensors = load(content)
            layers = range(int(facts["layers"]))
            driver = cls(
                name=str(facts["name"]),
                sizes={str(term): int(size) for term, size in facts["sizes"].items()},
                scale_observations=bool(facts["scale_observations"]),
                speeds=(float(facts["speeds"][0]), float(facts["speeds"][1])),
                activation=str(facts["activation"]),
                bounded=bool(facts.get("bounded", False)),  # files of earlier versions do not have it
                weights=tuple(tensors[f"weight_{i}"].astype(np.float32) for i in layers),
                biases=tuple(tensors[f"bias_{i}"].astype(np.float32) for i in layers),
            )
        except (OSError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, SafetensorError) as error:
            raise OutlapError(f"{path}: cannot be read as a driver: {brief(error)}") from None
        driver._check(path)
        return driver

    def _check(self, path: Path) -> None:
        if self.activation not in ACTIVATIONS:
            raise OutlapError(f"{path}: activation is {self.activation!r}; must be one of {', '.join(ACTIVATIONS)}")
        slowest, fastest = self.speeds
        if not -math.inf < slowest < fastest < math.inf:
            raise OutlapError(f"{path}: speeds are {slowest}, {fastest}; must be the slowest and the fastest [m/s]")
        width = sum(self.sizes.values())
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            outputs = bias.shape[0] if bias.ndim == 1 else -1
            if weight.shape != (width, outputs):
                raise OutlapError(f"{path}: layer {number} has weights {weight.shape}; must be ({width}, {outputs})")
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise OutlapError(f"{path}: layer {number} holds numbers that are not finite")
            width = outputs
        if width != 2:
            raise OutlapError(f"{path}: gives {width} numbers; must be 2, steer and speed")


class MLPStack(DriverStack):
    """Perceptrons of one architecture, asked as one batch of matrix products."""

    def __init__(self, drivers: Sequence[MLPDriver]) -> None:
        """Stack them. Raises OutlapError where their architectures differ."""
        first = drivers[0]
        for driver in drivers:
            if driver.architecture != first.architecture:
                raise OutlapError(f"{driver.name}: has another architecture than {first.name}; ask them one by one")
        self._drivers = drivers
        self._activation, self._bounded = ACTIVATIONS[first.activation], first.bounded
        depth = range(len(first.weights))
        self._weights = [np.stack([driver.weights[i] for driver in drivers]) for i in depth]
        self._biases = [np.stack([driver.biases[i] for driver in drivers])[:, None] for i in depth]

    def act(self, which: np.ndarray, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """See `DriverStack.act`.

        Raises OutlapError for an observation of another shape than the drivers were trained on.
        """
        for term, size in self._drivers[0].sizes.items():
            found = observation[term].shape
            if found != (len(which), size):
                raise OutlapError(
                    f"{self._drivers[0].name}: observation {term!r} has shape {found}; must be {(len(which), size)}"
                )
        seen = np.concatenate([observation[term] for term in self._drivers[0].observation_terms], axis=1)
        counts = np.bincount(which, minlength=len(self._drivers))
        order = np.argsort(which, kind="stable")
        place = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        at = which[order], place
        blocks = -(-counts.max(initial=0) // ROWS)
        x = np.zeros((len(counts), blocks * ROWS, seen.shape[1]), np.float32)
        x[at] = seen[order]
        found = np.empty((*x.shape[:2], 2), np.float32)
        for first in range(0, x.shape[1], ROWS):
            found[:, first : first + ROWS] = self._forward(x[:, first : first + ROWS])
        actions = np.empty((len(which), 2), np.float32)
        actions[order] = np.clip(found[at], -1.0, 1.0)
        return actions

    def _forward(self, x: np.ndarray) -> np.ndarray:
        """(drivers, ROWS, inputs) → (drivers, ROWS, 2)."""
        for number, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
            x = x @ weight + bias
            if number < len(self._weights) - 1:
                x = self._activation(x)
        return np.tanh(x) if self._bounded else x
