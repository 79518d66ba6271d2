"""A Stable-Baselines3 policy as a driver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from outlap.config import Config
from outlap.drivers.driver import Driver
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy

# Observations that a network sees at once. A matrix product rounds differently with the number of its rows;
# this many always, padded where there are fewer, make a car's action independent of the cars beside it.
BATCH = 64


class PolicyDriver(Driver):
    """Drives with the policy of a Stable-Baselines3 model, by default without its exploration noise.

    Actions do not depend on how many cars are asked about together, unless the policy is stochastic.
    """

    def __init__(
        self,
        model: BaseAlgorithm | BasePolicy,
        *,
        scale_observations: bool,
        deterministic: bool = True,
        seed: int = 0,
        name: str = "policy",
        speeds: tuple[float, float] | None = None,
        reward: Config | None = None,
    ) -> None:
        """Wrap a model.

        Args:
            model: or a policy by itself; its observation is a Dict of observation terms.
            scale_observations: whether it was trained on terms divided by their scale.
            deterministic: take the most likely action; otherwise draw from the policy's distribution.
            seed: of those draws.
            name: in results.
            speeds: [m/s] that its actions -1 and 1 commanded in training, for a car whose speeds are others; None:
                those of the car.
            reward: the RewardConfig that it was trained with, for one that observes rewards; None: the task's.

        Raises OutlapError for a model whose observations or actions are not those of outlap.
        """
        space = model.observation_space
        if not isinstance(space, gym.spaces.Dict):
            raise OutlapError(f"{name}: takes a {type(space).__name__} observation; must take a Dict of terms")
        if model.action_space.shape != (2,):
            raise OutlapError(f"{name}: gives actions of shape {model.action_space.shape}; must be (2,)")
        self.name = name
        self.observation_terms = tuple(space.spaces)
        self.scale_observations = scale_observations
        self.speeds = speeds
        self.reward = reward
        self.beams = _size(space["scan"]) if "scan" in space.spaces else None
        self._space = space
        self._policy: Any = getattr(model, "policy", model)
        self._policy.set_training_mode(False)
        self._deterministic = deterministic
        self._random = None if deterministic else _random_state(seed)
        self._begins = np.zeros(0, bool)
        self._memories: list[Any] = []  # of each block of cars; None for a policy without a memory
        self._padded = {
            term: np.zeros((BATCH, *box.shape), np.float32)  # type: ignore[misc]
            for term, box in space.spaces.items()
        }

    def check(self, space: gym.Space) -> None:
        """See `Driver.check`; the error names the first term that differs from the training's, and how."""
        offered = space.spaces if isinstance(space, gym.spaces.Dict) else {}
        for term, trained in self._space.spaces.items():
            shown = offered.get(term)
            if shown is None:
                raise OutlapError(f"{self.name}: needs the observation {term!r}; there are {', '.join(offered)}")
            if shown.shape != trained.shape:
                raise OutlapError(
                    f"{self.name}: was trained on {_size(trained)} numbers of {term!r} and would be shown "
                    f"{_size(shown)}; evaluate it with the environment that it was trained on"
                )
            assert isinstance(shown, gym.spaces.Box)
            assert isinstance(trained, gym.spaces.Box)
            for end in ("low", "high"):
                was, now = getattr(trained, end), getattr(shown, end)
                if not np.allclose(was, now):
                    at = int(np.flatnonzero(~np.isclose(was, now))[0])
                    raise OutlapError(
                        f"{self.name}: was trained on {term!r} with {end} = {was[at]:g} and would be shown one with "
                        f"{now[at]:g}; evaluate it with the same scaling and range"
                    )

    def begin(self, cars: np.ndarray) -> None:
        """See `Driver.begin`; a policy with a memory forgets what it remembers of these cars."""
        self._begins = np.array(cars, bool)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See `Driver.act`; raises OutlapError for an observation that the policy was not trained on."""
        count = len(observation[next(iter(observation))]) if observation else 0
        for term, box in self._space.spaces.items():
            if term not in observation:
                raise OutlapError(f"{self.name}: needs the observation {term!r}; it is given {', '.join(observation)}")
            found, needed = observation[term].shape, (count, *(box.shape or ()))
            if found != needed:
                raise OutlapError(f"{self.name}: observation {term!r} has shape {found}; must be {needed}")
        if self._random is None:
            return self._act(observation, count)
        import torch

        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._random)
            actions = self._act(observation, count)
            self._random = torch.get_rng_state()
        return actions

    def context(self) -> np.ndarray | None:
        """See `Driver.context`."""
        policy: Any = self._policy
        if not getattr(policy, "uses_context", False) or not self._memories:
            return None
        return np.concatenate([policy.context_of(memory) for memory in self._memories])[: len(self._begins)]

    def _act(self, observation: dict[str, np.ndarray], count: int) -> np.ndarray:
        if len(self._begins) != count:  # other cars than before
            self.begin(np.ones(count, bool))
            self._memories = []
        actions = np.empty((count, 2), np.float32)
        for block, first in enumerate(range(0, count, BATCH)):
            rows = min(BATCH, count - first)
            for term, padded in self._padded.items():
                padded[:rows] = observation[term][first : first + rows]
            begins = np.zeros(BATCH, bool)
            begins[:rows] = self._begins[first : first + rows]
            if block == len(self._memories):
                self._memories.append(None)
            chosen, self._memories[block] = self._policy.predict(
                self._padded,
                self._memories[block],
                begins,
                self._deterministic,  # type: ignore[arg-type]
            )
            actions[first : first + rows] = chosen[:rows]
        self._begins[:] = False
        return actions


def _random_state(seed: int):
    import torch

    return torch.Generator().manual_seed(seed).get_state()


def _size(space: gym.Space) -> int:
    return int(np.prod(space.shape or ()))
