"""Friction that differs from place to place on a track."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from outlap.errors import OutlapError
from outlap.track.map_io import read_number_columns

COLUMNS = ("s_m", "d_m", "mu")


@dataclass(frozen=True, eq=False)
class FrictionMap:
    """Friction on a grid along and across a track; linear in between, and constant beyond the outermost offsets."""

    s: np.ndarray  # (n,) [m] along the centreline, ascending
    d: np.ndarray  # (m,) [m] to its left, ascending
    mu: np.ndarray  # (n, m) [-]
    length: float  # [m] of the centreline, after which s begins anew

    def __post_init__(self) -> None:
        if self.mu.shape != (len(self.s), len(self.d)) or not len(self.s) or not len(self.d):
            raise OutlapError(f"friction: mu has shape {self.mu.shape}; it must be ({len(self.s)}, {len(self.d)})")
        for name, values in (("s_m", self.s), ("d_m", self.d)):
            if np.any(np.diff(values) <= 0.0):
                raise OutlapError(f"friction: {name} must grow from line to line of the grid")
        if not np.all(np.isfinite(self.mu)) or np.any(self.mu <= 0.0):
            bad = np.argwhere(~(self.mu > 0.0) | ~np.isfinite(self.mu))[0]
            raise OutlapError(
                f"friction: mu is {self.mu[tuple(bad)]} at s_m = {self.s[bad[0]]:g}, d_m = {self.d[bad[1]]:g}; "
                "it must be a positive number"
            )
        if self.s[0] < 0.0 or self.s[-1] >= self.length:
            raise OutlapError(
                f"friction: s_m is {self.s[0]:g} to {self.s[-1]:g}; it must lie on the lap, from 0 to {self.length:g} m"
            )

    @classmethod
    def read(cls, path: str | Path, length: float) -> FrictionMap:
        """Read a csv of `s_m, d_m, mu`, a row for every point of a grid, in any order.

        Raises OutlapError with the file, and what is wrong.
        """
        rows = read_number_columns(path, COLUMNS)
        s, along = np.unique(rows[:, 0], return_inverse=True)
        d, across = np.unique(rows[:, 1], return_inverse=True)
        mu = np.full((len(s), len(d)), np.nan)
        mu[along, across] = rows[:, 2]
        if len(rows) != mu.size or np.isnan(mu).any():
            raise OutlapError(
                f"{path}: has {len(rows)} rows for {len(s)} values of s_m and {len(d)} of d_m; "
                f"it must have one for each of the {mu.size} pairs"
            )
        try:
            return cls(s, d, mu, length)
        except OutlapError as error:
            raise OutlapError(f"{path}: {error}") from None

    def at(self, s: ArrayLike, d: ArrayLike) -> np.ndarray:
        """Friction at arc lengths and offsets (...) [m]: (...) [-]."""
        s, d = np.broadcast_arrays(np.asarray(s, np.float64) % self.length, np.asarray(d, np.float64))
        around = np.concatenate([[self.s[-1] - self.length], self.s, [self.s[0] + self.length]])
        values = self.mu[np.r_[-1, 0 : len(self.s), 0]]
        offsets = self.d
        if len(offsets) == 1:
            offsets, values = np.array([offsets[0], offsets[0] + 1.0]), np.repeat(values, 2, axis=1)
        table = RegularGridInterpolator((around, offsets), values)
        return table(np.stack([s, np.clip(d, offsets[0], offsets[-1])], axis=-1))
