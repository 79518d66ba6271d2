"""Which of the rows of a ring belong to a task: the index that a replay draws from."""

from __future__ import annotations

import numpy as np


class Recent:
    """The newest serials of one task."""

    def __init__(self, capacity: int) -> None:
        self.ring = np.zeros(min(64, capacity), np.int64)
        self.capacity = capacity
        self.added = 0
        self._found = (0, 0, 0)  # by `_first`: for which `oldest` and `added`, and what
        self.ascending = True  # as they come where all worlds step together: then the oldest are found by halves

    def extend(self, serials: np.ndarray) -> None:
        needed = min(self.added + len(serials), self.capacity)
        if needed > len(self.ring):  # only ever before the ring has turned over
            self.ring = grown(self.ring, min(max(needed, 2 * len(self.ring)), self.capacity))
        if self.added and serials[0] < self.ring[(self.added - 1) % len(self.ring)]:
            self.ascending = False
        self.ring[(self.added + np.arange(len(serials))) % len(self.ring)] = serials
        self.added += len(serials)

    def count(self, oldest: int) -> int:
        """How many there are from `oldest` on."""
        return self.added - self._first(oldest) if self.ascending else int((self._held() >= oldest).sum())

    def at(self, places: np.ndarray, oldest: int) -> np.ndarray:
        """Those at some places, 0 … count - 1, among the ones from `oldest` on."""
        if self.ascending:
            return self.ring[(self._first(oldest) + places) % len(self.ring)]
        held = self._held()
        return held[held >= oldest][places]

    def _held(self) -> np.ndarray:
        return self.ring[: min(self.added, len(self.ring))]

    def _first(self, oldest: int) -> int:
        if self._found[:2] != (oldest, self.added):
            held, turned = self._held(), max(0, self.added - len(self.ring))
            start = turned % len(self.ring) if turned else 0  # of the ring as it was filled
            newer = np.searchsorted(held[start:], oldest)
            if newer == len(held) - start:
                newer += np.searchsorted(held[:start], oldest)
            self._found = oldest, self.added, turned + int(newer)
        return self._found[2]


def grown(rows: np.ndarray, capacity: int) -> np.ndarray:
    """With zeros behind them, up to `capacity` rows."""
    grown = np.zeros((capacity, *rows.shape[1:]), rows.dtype)
    grown[: len(rows)] = rows
    return grown
