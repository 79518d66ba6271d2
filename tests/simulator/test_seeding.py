"""The hash against its published numbers; what it gives against uniform and independent."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from oracles import splitmix64
from outlap.simulator.seeding import (
    DRIVER_STREAM,
    PARAMETER_STREAM,
    START_STREAM,
    TRACK_STREAM,
    hash64,
    uniform,
    world_keys,
)

STREAMS = (TRACK_STREAM, PARAMETER_STREAM, START_STREAM, DRIVER_STREAM)


def test_the_hash_gives_the_published_numbers_of_splitmix64():
    # Of the reference implementation with seed 1234567 (prng.di.unimi.it/splitmix64.c).
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert splitmix64(1234567, 4) == published
    assert [int(hash64(np.uint64(1234567), np.uint64(k))) for k in range(4)] == published


@pytest.mark.parametrize("key", [0, 1, 2**32, 2**63 + 17, 2**64 - 1])
def test_the_hash_is_splitmix64_for_every_key(key):
    expected = splitmix64(key, 20)
    assert [int(hash64(np.uint64(key), np.uint64(k))) for k in range(20)] == expected


def test_uniform_numbers_are_uniform():
    numbers = uniform(world_keys(range(200)), np.zeros(200), PARAMETER_STREAM, 200)
    assert numbers.shape == (200, 200)
    assert numbers.min() >= 0.0
    assert numbers.max() < 1.0
    assert stats.kstest(numbers.ravel(), "uniform").pvalue > 1e-3
    # Along either axis too: one column over the worlds, one world over the columns.
    assert stats.kstest([stats.kstest(row, "uniform").pvalue for row in numbers], "uniform").pvalue > 1e-3
    assert stats.kstest([stats.kstest(col, "uniform").pvalue for col in numbers.T], "uniform").pvalue > 1e-3


def test_neighbouring_seeds_episodes_streams_and_numbers_are_independent():
    keys = world_keys(range(40))
    numbers = np.array(
        [[uniform(keys, np.full(40, episode), stream, 30) for stream in STREAMS] for episode in range(10)]
    )  # (episodes, streams, worlds, numbers)
    for axis in range(4):
        for lag in (1, 2, 3):
            first = np.take(numbers, range(numbers.shape[axis] - lag), axis).ravel()
            second = np.take(numbers, range(lag, numbers.shape[axis]), axis).ravel()
            bound = 4.5 / math.sqrt(first.size)
            assert abs(np.corrcoef(first, second)[0, 1]) < bound
            # Nor do they have the same last bits.
            first_odd, second_odd = first * 2.0**53 % 2.0, second * 2.0**53 % 2.0
            assert abs(np.corrcoef(first_odd, second_odd)[0, 1]) < bound
    assert len(np.unique(numbers)) == numbers.size


def test_equal_seeds_give_equal_numbers_whatever_the_company():
    keys = world_keys([7, 8, 7])
    numbers = uniform(keys, np.array([3, 3, 3]), START_STREAM, 6)
    np.testing.assert_array_equal(numbers[0], numbers[2])
    alone = uniform(world_keys([8]), np.array([3]), START_STREAM, 4)
    np.testing.assert_array_equal(numbers[1, :4], alone[0])


def test_each_world_has_its_own_episode():
    keys = world_keys([7, 8])
    mixed = uniform(keys, np.array([0, 5]), START_STREAM, 4)
    np.testing.assert_array_equal(mixed[0], uniform(keys, np.array([0, 0]), START_STREAM, 4)[0])
    np.testing.assert_array_equal(mixed[1], uniform(keys, np.array([5, 5]), START_STREAM, 4)[1])


def test_keys_of_seeds_differ_and_repeat():
    seeds = [*range(2000), 2**32, 2**63, 2**100]
    keys = world_keys(seeds)
    assert keys.dtype == np.uint64
    assert len(np.unique(keys)) == len(seeds)
    np.testing.assert_array_equal(keys, world_keys(seeds))
    bits = np.unpackbits(keys.view(np.uint8))
    assert abs(bits.mean() - 0.5) < 4.0 * 0.5 / math.sqrt(bits.size)


def test_one_changed_bit_of_key_or_counter_changes_half_of_the_hash():
    rng = np.random.default_rng(0)
    flipped = []
    for bit, _ in itertools.product(range(64), range(20)):
        key, counter = rng.integers(0, 2**63, 2, dtype=np.uint64)
        one = np.uint64(1) << np.uint64(bit)
        here = hash64(key, counter)
        flipped += [
            int(here ^ hash64(key ^ one, counter)).bit_count(),
            int(here ^ hash64(key, counter ^ one)).bit_count(),
        ]
    assert np.mean(flipped) == pytest.approx(32.0, abs=0.5)
    assert min(flipped) >= 10
