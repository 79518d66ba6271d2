"""Opponents that nobody trained: perceptrons with random weights, one that laps a ring, and populations of both."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import Member, Split, file_hashes, write_manifest

STEER_STOP = 0.4189  # [rad] of the F1TENTH car


def driver(seed: int = 0, name: str = "one", *, beams: int = 24, speeds: tuple[float, float] = (0.0, 4.0)) -> MLPDriver:
    """A perceptron with random weights, which looks."""
    rng = np.random.default_rng(seed)
    shapes = [(beams + 5, 16), (16, 16), (16, 2)]
    weights = tuple(rng.normal(0, 0.3, shape).astype(np.float32) for shape in shapes)
    biases = tuple(rng.normal(0, 0.3, shape[1]).astype(np.float32) for shape in shapes)
    return MLPDriver(
        name=name, sizes={"scan": beams, "vel": 3, "heading": 2}, scale_observations=True, speeds=speeds,
        activation="tanh", weights=weights, biases=biases,
    )  # fmt: skip


def ring_driver(
    radius: float, name: str = "round", *, speed_action: float = 0.0, speeds: tuple[float, float] = (0.0, 4.0)
) -> MLPDriver:
    """A perceptron of one layer that follows the centreline of a ring with a constant action for its speed."""
    weights = np.array([[-0.3 / STEER_STOP, 0.0], [-0.9 / STEER_STOP, 0.0]], np.float32)  # of offset, heading error
    bias = np.array([math.atan(0.33 / radius) / STEER_STOP, speed_action], np.float32)
    return MLPDriver(
        name=name, sizes={"frenet": 2}, speeds=speeds, activation="tanh", weights=(weights,), biases=(bias,)
    )


def save_population(folder: Path, *halves: tuple[MLPDriver, Split], track: str = "ring") -> Path:
    """A population's folder of these drivers, each in its half, with the track that its manifest names."""
    members = []
    for each, split in halves:
        each.save(folder / each.name)
        members.append(
            Member(
                name=each.name,
                max_speed_mps=each.speeds[1],
                split=split,
                track=track,
                verified_laps=5,
                crash_rate=0.0,
                lap_time_s=10.0,
                command="outlap opponents train",
                sha256=file_hashes(folder, each.name),
            )
        )
    write_manifest(folder, members[::-1])
    return folder


def population(folder: Path, *splits: Split) -> Path:
    """A population's folder of random drivers: ring-2.0, ring-3.0 and so on, by their top speeds [m/s]."""
    speeds = [2.0 + number for number in range(len(splits))]
    drivers = [driver(seed, f"ring-{top}", speeds=(0.0, top)) for seed, top in enumerate(speeds)]
    return save_population(folder, *zip(drivers, splits, strict=True))
