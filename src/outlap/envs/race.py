"""Race: what the functions that observe, reward and end an episode can look at.

Arrays are (worlds, ...) and, except for `worlds`, belong to the step just made.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from outlap.simulator import state as column
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING
from outlap.simulator.collision import FREE
from outlap.simulator.kernels import ARC_LENGTH
from outlap.simulator.simulator import Simulator
from outlap.simulator.vehicle import LENGTH

EGO = 0


@dataclass
class Race:
    """The worlds, and what an episode needs to remember beside them."""

    simulator: Simulator
    reference_speed: np.ndarray  # float32 (rows of the atlas,) [m/s], see `reference_speeds`
    training_steps: int = 0  # environment steps so far, all worlds together
    actions: np.ndarray = field(init=False)  # (worlds, cars, 2) of this step
    actions_before: np.ndarray = field(init=False)  # of the step before; after a reset equal to `actions`
    start: np.ndarray = field(init=False)  # (worlds,) unwrapped distance of the ego at the reset [m]
    distance_before: np.ndarray = field(init=False)  # (worlds,) one step ago [m]
    farthest: np.ndarray = field(init=False)  # (worlds,) unwrapped distance reached so far [m]
    farthest_before: np.ndarray = field(init=False)  # one step ago [m]
    farthest_time: np.ndarray = field(init=False)  # when that last grew by the stall distance [s]
    stall_mark: np.ndarray = field(init=False)  # (worlds,) distance at that time [m]
    stalled: np.ndarray = field(init=False)  # bool (worlds,): this step ended the episode for want of progress
    ahead: np.ndarray = field(init=False)  # (worlds, cars) whether the ego is ahead of each car
    places_gained: np.ndarray = field(init=False)  # (worlds,) in this step
    places_lost: np.ndarray = field(init=False)
    rewards: np.ndarray = field(init=False)  # (worlds,) of this step, 0 after a reset

    def __post_init__(self) -> None:
        simulator = self.simulator
        worlds, cars = simulator.num_worlds, simulator.num_cars
        self.actions = np.zeros((worlds, cars, 2), np.float32)
        self.actions_before = np.zeros((worlds, cars, 2), np.float32)
        for name in (
            "start",
            "distance_before",
            "farthest",
            "farthest_before",
            "farthest_time",
            "stall_mark",
        ):
            setattr(self, name, np.zeros(worlds))
        self.stalled = np.zeros(worlds, bool)
        self.ahead = np.zeros((worlds, cars), bool)
        self.places_gained = np.zeros(worlds, np.int64)
        self.places_lost = np.zeros(worlds, np.int64)
        self.rewards = np.zeros(worlds)

    @property
    def worlds(self):
        """The simulator's live arrays."""
        return self.simulator.worlds

    @property
    def length(self) -> np.ndarray:
        """Of each world's centreline: (worlds,) [m]."""
        atlas, track = self.simulator.atlas, self.worlds.track
        return atlas.index[track, ROWS] * atlas.frame[track, SPACING]

    @property
    def distance(self) -> np.ndarray:
        """The ego's unwrapped arc length: (worlds,) [m]."""
        return self.worlds.distance[:, EGO]

    @property
    def speed(self) -> np.ndarray:
        """Of the ego: (worlds,) [m/s], negative in reverse."""
        return self.worlds.state[:, EGO, column.SPEED]

    @property
    def crashed(self) -> np.ndarray:
        """Whether the ego touches a wall or a car: bool (worlds,)."""
        return self.worlds.contact[:, EGO] != FREE

    def line_rows(self, car: int, ahead: np.ndarray) -> np.ndarray:
        """Rows of the atlas' centreline tables at distances ahead of a car [m]: int (worlds, len(ahead))."""
        atlas, track = self.simulator.atlas, self.worlds.track
        first, rows = atlas.index[track, FIRST_ROW], atlas.index[track, ROWS]
        s = self.worlds.frenet[:, car, ARC_LENGTH, None] + ahead
        row = np.rint(s / atlas.frame[track, SPACING, None]).astype(np.int64)
        return first[:, None] + row % rows[:, None]

    def line_values(self, car: int, table_column: int, ahead: np.ndarray) -> np.ndarray:
        """A column of the centreline table at distances ahead of a car [m]: (worlds, len(ahead))."""
        return self.simulator.atlas.line[self.line_rows(car, ahead), table_column]

    def begin(self, which: np.ndarray) -> None:
        """Take note of worlds that were just reset."""
        worlds = self.worlds
        self.actions[which] = 0.0
        self.actions_before[which] = 0.0
        distance = worlds.distance[which, EGO]
        for array in (self.start, self.distance_before, self.farthest, self.farthest_before, self.stall_mark):
            array[which] = distance
        self.farthest_time[which] = 0.0
        self.ahead[which] = distance[:, None] > worlds.distance[which]
        self.places_gained[which] = 0
        self.places_lost[which] = 0
        self.rewards[which] = 0.0

    def act(self, actions: np.ndarray) -> None:
        """Take note of the actions (worlds, cars, 2) that the next step will carry out."""
        self.actions_before[:] = self.actions
        self.actions[:] = actions
        self.distance_before[:] = self.distance

    def advance(self, stall_distance: float) -> None:
        """Take note of what the simulator's step did."""
        worlds = self.worlds
        self.farthest_before[:] = self.farthest
        np.maximum(self.farthest, self.distance, out=self.farthest)
        moved = self.farthest >= self.stall_mark + stall_distance
        self.stall_mark[moved] = self.farthest[moved]
        self.farthest_time[moved] = worlds.time[moved]
        self._change_places()

    def _change_places(self) -> None:
        """A place is gained by leading a car by a length after having trailed it, and lost the other way."""
        lead = self.distance[:, None] - self.worlds.distance
        margin = self.worlds.params[:, :, LENGTH]
        gained = ~self.ahead & (lead > margin)
        lost = self.ahead & (lead < -margin)
        self.ahead ^= gained | lost
        self.places_gained[:] = gained.sum(axis=1)
        self.places_lost[:] = lost.sum(axis=1)
