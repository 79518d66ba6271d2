"""EpisodeSeeds: the random stream of each world, and the number of its episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from outlap.errors import OutlapError
from outlap.simulator.seeding import world_keys


class EpisodeSeeds:
    """A key for each world and the number of its episode; together they determine all that an episode draws.

    Keys are random until `seed` sets them.
    """

    def __init__(self, num_envs: int) -> None:
        self._keys = np.random.SeedSequence().generate_state(num_envs, np.uint64)
        self._episode = np.zeros(num_envs, np.int64)  # number of each world's episode since it was seeded

    def seed(self, seed: Any, which: np.ndarray) -> int | None:
        """Restart the streams of some worlds, (n,) numbers, and return the first world's seed.

        Args:
            seed: one for each world, None to continue a world's stream; a single number gives world i the seed + i.
            which: the worlds to seed.

        Raises OutlapError for a seed that is not a whole number from 0, and for a wrong number of seeds.
        """
        count = len(self._keys)
        if isinstance(seed, (int, np.integer)):
            first = int(cast("int", seed))
            seeds: list[Any] = [first + i for i in range(count)]
        else:
            seeds = [*cast("Sequence[Any]", seed)] if isinstance(seed, (Sequence, np.ndarray)) else [seed]
        for each in seeds:
            if each is not None and not (isinstance(each, (int, np.integer)) and each >= 0):
                raise OutlapError(f"seed is {each!r}; it must be a whole number, 0 or more")
        if len(seeds) != count:
            raise OutlapError(f"seed: {len(seeds)} given for {count} worlds; give one, or one a world")
        chosen = {int(world): int(given) for world in which if (given := seeds[world]) is not None}
        self._keys[list(chosen)] = world_keys(list(chosen.values()))
        self._episode[list(chosen)] = 0
        return seeds[0]

    def next_episodes(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance some worlds, (n,) numbers, to their next episode: keys uint64 (n,), episode numbers int64 (n,)."""
        self._episode[which] += 1
        return self._keys[which], self._episode[which]
