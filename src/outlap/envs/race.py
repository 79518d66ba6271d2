"""Race: what the functions that observe, reward and end an episode can look at.

Arrays are (worlds, cars, ...) and, except for `worlds`, belong to the step just made.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from outlap.envs.car_sets import NO_CAR
from outlap.envs.racing_line import ReferenceSpeeds
from outlap.simulator import state as column
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING
from outlap.simulator.collision import FREE, REMOVED
from outlap.simulator.simulator import Simulator
from outlap.simulator.worlds import ARC_LENGTH, Worlds

EGO = 0
RUNNING = ""  # the outcome of a race that continues


@dataclass
class Race:
    """The worlds, and what an episode needs to remember beside them."""

    simulator: Simulator
    nearby_cars: int  # of which the observation term of that name tells
    racing_line: np.ndarray  # float32 (rows of the atlas, 3), see `racing_lines`
    reference: ReferenceSpeeds | None = None  # for the reward that asks for them
    training_progress: float = 1.0  # share of the training that is done: where reward curricula stand
    actions: np.ndarray = field(init=False)  # (worlds, cars, 2) of this step
    actions_before: np.ndarray = field(init=False)  # of the step before; after a reset equal to `actions`
    speeds: np.ndarray = field(init=False)  # (worlds, cars, 2) [m/s] that the speed actions -1 and 1 command
    start: np.ndarray = field(init=False)  # unwrapped distance at the reset [m]
    distance_before: np.ndarray = field(init=False)  # one step ago [m]
    farthest: np.ndarray = field(init=False)  # unwrapped distance reached so far [m]
    farthest_before: np.ndarray = field(init=False)  # one step ago [m]
    farthest_time: np.ndarray = field(init=False)  # when that last grew by the stall distance [s]
    stall_mark: np.ndarray = field(init=False)  # distance at that time [m]
    outcome: np.ndarray = field(init=False)  # str: how this step ended the car's race, see `terminations`
    ahead: np.ndarray = field(init=False)  # bool (worlds, cars, cars): whether the first car is ahead of the second
    racing: np.ndarray = field(init=False)  # bool: on the track
    places_gained: np.ndarray = field(init=False)  # in this step
    places_lost: np.ndarray = field(init=False)
    cars: np.ndarray = field(init=False)  # int64 (worlds, cars): number in the set of cars, or NO_CAR
    rewards: np.ndarray = field(init=False)  # of this step, 0 after a reset
    final_rewards: np.ndarray = field(init=False)  # the same as they are when the training ends

    def __post_init__(self) -> None:
        everyone = self.simulator.num_worlds, self.simulator.num_cars
        self.actions = np.zeros((*everyone, 2), np.float32)
        self.actions_before = np.zeros((*everyone, 2), np.float32)
        self.speeds = np.zeros((*everyone, 2), np.float32)
        self.start = np.zeros(everyone)
        self.distance_before = np.zeros(everyone)
        self.farthest = np.zeros(everyone)
        self.farthest_before = np.zeros(everyone)
        self.farthest_time = np.zeros(everyone)
        self.stall_mark = np.zeros(everyone)
        self.outcome = np.full(everyone, RUNNING, "U8")
        self.ahead = np.zeros((*everyone, everyone[1]), bool)
        self.racing = np.ones(everyone, bool)
        self.places_gained = np.zeros(everyone, np.int64)
        self.places_lost = np.zeros(everyone, np.int64)
        self.cars = np.full(everyone, NO_CAR, np.int64)
        self.rewards = np.zeros(everyone)
        self.final_rewards = np.zeros(everyone)

    @property
    def worlds(self) -> Worlds:
        """The simulator's live arrays."""
        return self.simulator.worlds

    @property
    def length(self) -> np.ndarray:
        """Of each world's centreline: (worlds,) [m]."""
        return self.track_lengths(self.worlds.track)

    def track_lengths(self, tracks: np.ndarray) -> np.ndarray:
        """The lengths of the centrelines of tracks (n,): (n,) [m]."""
        atlas = self.simulator.atlas
        return atlas.index[tracks, ROWS] * atlas.frame[tracks, SPACING]

    @property
    def distance(self) -> np.ndarray:
        """Unwrapped arc length: (worlds, cars) [m]."""
        return self.worlds.distance

    @property
    def speed(self) -> np.ndarray:
        """(worlds, cars) [m/s], negative in reverse."""
        return self.worlds.state[..., column.SPEED]

    @property
    def crashed(self) -> np.ndarray:
        """Whether a car touched a wall or a car: bool (worlds, cars)."""
        return self.worlds.contact != FREE

    def line_rows(self, car: int, ahead: np.ndarray) -> np.ndarray:
        """Rows of the atlas' centreline tables at distances ahead of a car [m]: int (worlds, len(ahead))."""
        atlas, track = self.simulator.atlas, self.worlds.track
        first, rows = atlas.index[track, FIRST_ROW], atlas.index[track, ROWS]
        s = self.worlds.frenet[:, car, ARC_LENGTH, None] + ahead
        row = np.rint(s / atlas.frame[track, SPACING, None]).astype(np.int64)
        return first[:, None] + row % rows[:, None]

    def line_values(self, car: int, name: str, ahead: np.ndarray) -> np.ndarray:
        """Return a field of the centreline's table at distances ahead of a car [m]: (worlds, len(ahead))."""
        return self.simulator.atlas.line[name][self.line_rows(car, ahead)]

    def begin(self, which: np.ndarray, cars: np.ndarray) -> None:
        """Note that worlds were just reset, with cars of these numbers, (n, cars), see `tasks.Tasks`."""
        self.cars[which] = cars
        if self.reference is not None:
            self.reference.begin(which, self.worlds.track[which], self.worlds.params[which])
        self.actions[which] = 0.0
        self.actions_before[which] = 0.0
        distance = self.distance[which]
        for array in (self.start, self.distance_before, self.farthest, self.farthest_before, self.stall_mark):
            array[which] = distance
        self.farthest_time[which] = 0.0
        self.ahead[which] = distance[:, :, None] > distance[:, None]
        self.racing[which] = True
        self.places_gained[which] = 0
        self.places_lost[which] = 0
        self.outcome[which] = RUNNING
        self.rewards[which] = 0.0
        self.final_rewards[which] = 0.0

    def act(self, actions: np.ndarray) -> None:
        """Take note of the actions (worlds, cars, 2) that the next step will carry out."""
        self.actions_before[:] = self.actions
        self.actions[:] = actions
        self.distance_before[:] = self.distance

    def advance(self, stall_distance: float) -> None:
        """Take note of what the simulator's step did."""
        self.farthest_before[:] = self.farthest
        np.maximum(self.farthest, self.distance, out=self.farthest)
        moved = self.farthest >= self.stall_mark + stall_distance
        self.stall_mark[moved] = self.farthest[moved]
        self.farthest_time[moved] = np.broadcast_to(self.worlds.time[:, None], moved.shape)[moved]
        if self.simulator.num_cars > 1:
            self._change_places()

    def _change_places(self) -> None:
        """A place is gained by leading a car by a length after having trailed it, and lost the other way.

        A car that was taken off the track keeps its place: nobody passes it any more.
        """
        lead = self.distance[:, :, None] - self.distance[:, None]
        margin = self.worlds.params["length"][:, None, :]
        racing = self.worlds.contact != REMOVED
        back = racing & ~self.racing  # put back on the track: whoever went by meanwhile has overtaken nobody
        np.copyto(self.ahead, lead > 0.0, where=back[:, :, None] | back[:, None])
        self.racing[:] = racing
        both = racing[:, :, None] & racing[:, None]
        gained = ~self.ahead & (lead > margin) & both
        lost = self.ahead & (lead < -margin) & both
        self.ahead ^= gained | lost
        self.places_gained[:] = gained.sum(axis=2)
        self.places_lost[:] = lost.sum(axis=2)
