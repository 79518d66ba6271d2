"""What a driver would say of a circuit: its straights, hairpins and chicanes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from outlap.track.centerline import Centerline


@dataclass(frozen=True)
class CircuitFeatures:
    """What a driver would say of a circuit; see measure_features."""

    length: float  # [m]
    turning: float  # [rad] ∫ |curvature| ds; 2π for a circle
    tightest_radius: float  # [m]
    straights: tuple[float, ...]  # [m] lengths, longest first
    hairpins: int
    chicanes: int


def measure_features(centerline: Centerline) -> CircuitFeatures:
    """Straights, hairpins and chicanes of any circuit, by these definitions.

    A straight is a stretch of 5 m or more with a radius above 50 m. A corner is a stretch that turns
    one way with a radius below 50 m. A hairpin is a corner that turns 150° or more within 12 m. A
    chicane is a pair of successive corners, one left and one right, that turn 25° or more each, with
    their middles at most 10 m apart.
    """
    count = math.ceil(centerline.length / 0.1)
    step = centerline.length / count
    s = np.arange(count) * step
    curvature = centerline.curvature(s)
    way = np.where(np.abs(curvature) < 1 / 50, 0, np.sign(curvature)).astype(int)
    changes = np.flatnonzero(way != np.roll(way, 1))
    if len(changes) == 0:  # a circle: one endless corner
        changes = np.array([0])
    curvature, way = np.roll(curvature, -changes[0]), np.roll(way, -changes[0])
    bounds = np.append(changes - changes[0], len(s))
    window = round(12 / step)
    straights, corners, hairpins = [], [], 0
    for start, end in itertools.pairwise(bounds):
        if way[start] == 0:
            if (end - start) * step >= 5:
                straights.append(float((end - start) * step))
            continue
        turned = np.append(0.0, np.cumsum(curvature[start:end]) * step)
        middle = (start + np.searchsorted(np.abs(turned), abs(turned[-1]) / 2)) * step
        corners.append((turned[-1], middle))
        within = min(window, end - start)
        hairpins += bool(np.max(np.abs(turned[within:] - turned[:-within])) >= math.radians(150))
    chicanes = 0
    for (turn, middle), (next_turn, next_middle) in zip(corners, corners[1:] + corners[:1], strict=True):
        opposite = turn * next_turn < 0 and min(abs(turn), abs(next_turn)) >= math.radians(25)
        chicanes += bool(opposite and (next_middle - middle) % centerline.length <= 10)
    return CircuitFeatures(
        length=centerline.length,
        turning=float(np.sum(np.abs(curvature)) * step),
        tightest_radius=float(1 / np.max(np.abs(curvature))),
        straights=tuple(sorted(straights, reverse=True)),
        hairpins=hairpins,
        chicanes=chicanes,
    )
