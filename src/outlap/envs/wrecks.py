"""Wrecks: opponents that crashed."""

from __future__ import annotations

from typing import Literal

import numpy as np

from outlap.envs.race import EGO, Race
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL

CrashRule = Literal["park", "remove", "respawn"]
"""What becomes of an opponent that crashed: it stays, leaves the track, or returns to the centreline at rest."""

RESPAWN_CLEARANCE = 3.0  # [m] to the middle of every other car, before an opponent comes back


class Wrecks:
    """Finds the opponents that crash and applies the rule of the race to them."""

    def __init__(self, race: Race, rule: CrashRule) -> None:
        worlds, cars = race.distance.shape
        self.new = np.zeros((worlds, cars - 1), bool)  # opponents that crashed in the last step
        self._down = np.zeros((worlds, cars - 1), bool)  # opponents that are not driving
        self._race = race
        self._rule: CrashRule = rule

    def begin(self, which: np.ndarray) -> None:
        """Forget the wrecks of worlds, (n,) numbers, that begin an episode."""
        self._down[which] = False

    def update(self) -> None:
        """Find the opponents that crashed in the last step; park, remove or respawn those that are down."""
        simulator, contact = self._race.simulator, self._race.worlds.contact
        wrecks = (contact == HIT_WALL) | (contact == HIT_CAR)
        wrecks[:, EGO] = False
        self.new[:] = wrecks[:, 1:] & ~self._down
        self._down[:] = contact[:, 1:] != FREE
        if self._rule != "park" and self._down.any():
            simulator.remove(wrecks)
            if self._rule == "respawn":
                simulator.respawn(RESPAWN_CLEARANCE)
