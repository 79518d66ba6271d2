"""Crash hot spots: places along a lap where more crashes happen than chance explains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from outlap.envs.terminations import CRASH

WINDOW = 5.0  # [m] of the lap that crashes of one hot spot lie in, and least distance between two hot spots
FEWEST = 3  # crashes of a hot spot
SIGNIFICANCE = 0.01  # chance that a track on which crashes fall anywhere is said to have a hot spot


@dataclass(frozen=True)
class HotSpot:
    """A place where crashes cluster."""

    track: str
    s_m: float  # median position of its crashes along the centreline [m]
    crashes: int
    share: float  # of all crashes on the track


def hot_spots(rows: pd.DataFrame, lengths: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the hot spots of all tracks as plain data, those with most crashes first; see `HotSpot`.

    Args:
        rows: of `evaluate`, with `track`, `outcome` and `crash_s_m` [m].
        lengths: of the centreline of each track [m], by name.
    """
    crashes = rows.loc[rows["outcome"] == CRASH]
    found: list[HotSpot] = []
    for name, group in crashes.groupby("track", sort=False):
        track, s = str(name), np.asarray(group["crash_s_m"], np.float64)
        for members in find_clusters(s, lengths[track]):
            middle = round(_circular_median(s[members], lengths[track]), 1) % lengths[track]
            found.append(HotSpot(track, middle, len(members), len(members) / len(s)))
    return [asdict(each) for each in sorted(found, key=lambda each: -each.crashes)]


def find_clusters(s: np.ndarray, length: float) -> list[np.ndarray]:
    """Return the crashes of each hot spot, as positions in `s`; in the order of the lap.

    A window of 5 m that begins at a crash is crowded if it holds k ≥ 3 of the n crashes and, with all of them falling
    anywhere on the lap, the chance that any window is as full is below 1 %. That chance is at most
    n · P(X ≥ k - 1) with X binomial (n - 1 trials, probability 5 m / length): one of the n crashes is the first in the
    window, and k - 1 others follow it. This is a union bound on the scan statistic of Naus (1965), The distribution of
    the size of the maximum cluster of points on a line. The crashes of crowded windows are set aside and the rest is
    tested again, so that one corner with most crashes hides no other. What lies less than 5 m apart is one hot spot.

    Args:
        s: arc length of each crash (n,) [m], in [0, length).
        length: of the lap [m].
    """
    hot = np.zeros(len(s), bool)
    while (crowded := _crowded(s[~hot], length)).any():
        hot[np.flatnonzero(~hot)[crowded]] = True
    members = np.flatnonzero(hot)
    if not len(members):
        return []
    members = members[np.argsort(s[members], kind="stable")]
    gaps = np.diff(s[members], append=s[members[0]] + length)  # to the next one, across the start line for the last
    ends = np.flatnonzero(gaps > WINDOW)
    if not len(ends):
        return [members]
    # Begin after a gap: a cluster at the start line is then in one piece.
    members, ends = np.roll(members, -(ends[0] + 1)), ends - ends[0]
    return sorted(np.split(members, ends[1:]), key=lambda cluster: float(s[cluster[0]]))


def _crowded(s: np.ndarray, length: float) -> np.ndarray:
    """Return which crashes (n,) lie in a crowded window."""
    n = len(s)
    crowded = np.zeros(n, bool)
    if n < FEWEST:
        return crowded
    order = np.argsort(s, kind="stable")
    twice = np.concatenate([s[order], s[order] + length])
    first = np.arange(n)
    count = np.minimum(np.searchsorted(twice, s[order] + WINDOW, side="right") - first, n)
    chance = n * stats.binom.sf(count - 2, n - 1, min(1.0, WINDOW / length))
    for window in np.flatnonzero((count >= FEWEST) & (chance < SIGNIFICANCE)):
        crowded[order[(window + np.arange(count[window])) % n]] = True
    return crowded


def _circular_median(s: np.ndarray, length: float) -> float:
    """Return the median of positions [m] that are given in the order of the lap, perhaps across the start line."""
    return float((s[0] + np.median((s - s[0]) % length)) % length)
