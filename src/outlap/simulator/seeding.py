"""One seed → independent streams of random numbers for every world, episode and purpose.

A number is a hash of (key of the world, episode, stream, index): no state to keep, to share between threads
or to forget in a checkpoint, and the same whatever the number of worlds or threads. The hash is the
finaliser of SplitMix64 (Steele, Lea and Flood, Fast Splittable Pseudorandom Number Generators, 2014).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

# Purposes: numbers drawn for one never depend on how many another draws.
TRACK_STREAM, PARAMETER_STREAM, START_STREAM, DRIVER_STREAM, NOISE_STREAM, CAR_STREAM, ROAD_STREAM = range(7)


def world_keys(seeds: Sequence[int]) -> np.ndarray:
    """The 64-bit key of each world's seed: uint64 (worlds,). Equal seeds give equal keys."""
    return np.array([np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] for seed in seeds])


@njit(cache=True)
def hash64(key: np.uint64, counter: np.uint64) -> np.uint64:
    """A 64-bit hash of (key, counter), both uint64."""
    z = key + (counter + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def _fill_uniform(keys: np.ndarray, episodes: np.ndarray, stream: int, out: np.ndarray) -> None:
    for row in range(out.shape[0]):
        key = hash64(hash64(keys[row], np.uint64(episodes[row])), np.uint64(stream))
        for column in range(out.shape[1]):
            bits = hash64(key, np.uint64(column)) >> np.uint64(11)
            out[row, column] = np.float64(bits) * 2.0**-53


def uniform(keys: np.ndarray, episodes: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Numbers uniform in [0, 1): float64 (worlds, count).

    Args:
        keys: uint64 (worlds,), from `world_keys`.
        episodes: (worlds,) number of the episode that each world begins.
        stream: what the numbers are for, one of the `*_STREAM`.
        count: how many for each world.
    """
    out = np.empty((len(keys), count))
    _fill_uniform(keys, np.asarray(episodes, np.uint64), stream, out)
    return out
