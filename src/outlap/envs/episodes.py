"""Episodes: statistics of the running episodes, and the `info` that reports them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from outlap.envs.opponents import Opponents
from outlap.envs.race import EGO, Race
from outlap.simulator.vehicle import to_values

CONTACTS = np.array(["", "wall", "car", ""], dtype=object)  # what was hit, by FREE, HIT_WALL, HIT_CAR, REMOVED
EPISODE_FIELDS = (
    "episode_return", "episode_steps", "progress_m", "mean_speed_mps", "completed_laps", "lap_time_s",
    "overtakes", "places_lost", "impact_speed_mps", "opponent_crashes",
)  # fmt: skip
"""Statistics of an episode, so far or at its end, in `info`."""

REWARD_PREFIX = "reward_"  # of the return of each reward term in `info`


class Episodes:
    """Statistics of the episode of each world, for its first car, and the name of its task."""

    def __init__(self, race: Race, opponents: Opponents, reward_terms: Iterable[str]) -> None:
        """Prepare the statistics of a race.

        Args:
            race: to report on.
            opponents: the other cars of the race.
            reward_terms: names of the terms whose returns are kept.
        """
        worlds = race.simulator.num_worlds
        self._race = race
        self._opponents = opponents
        self._track_names = np.array([track.name for track in race.simulator.tracks], dtype=object)
        self._task = np.full(worlds, "", object)
        self._statistics = {name: np.zeros(worlds) for name in EPISODE_FIELDS}
        self._returns = {name: np.zeros(worlds) for name in reward_terms}

    def begin(self, which: np.ndarray) -> None:
        """Start the statistics of worlds, (n,) numbers, that were just reset."""
        for total in (*self._statistics.values(), *self._returns.values()):
            total[which] = 0.0
        self._statistics["lap_time_s"][which] = np.nan
        tracks = self._track_names[self._race.worlds.track[which]].tolist()
        if self._opponents.drivers:
            rivals = self._opponents.names()[which].tolist()
            tracks = [
                f"{track} against {', '.join(sorted(names))}" for track, names in zip(tracks, rivals, strict=True)
            ]
        self._task[which] = tracks

    def update(self, reward_terms: Mapping[str, np.ndarray], opponent_crashes: np.ndarray) -> None:
        """Add the last step to the statistics.

        Args:
            reward_terms: the weighted reward terms of the first car, (worlds,) each.
            opponent_crashes: opponents that crashed in the last step, (worlds,).
        """
        race, worlds, statistics = self._race, self._race.worlds, self._statistics
        for name, value in reward_terms.items():
            self._returns[name] += value
        statistics["episode_return"] += race.rewards[:, EGO]
        statistics["episode_steps"] += 1
        mean_speed = statistics["mean_speed_mps"]
        mean_speed += (race.speed[:, EGO] - mean_speed) / statistics["episode_steps"]
        statistics["progress_m"][:] = race.distance[:, EGO] - race.start[:, EGO]
        # The mean of all laps so far: each new one moves it by its share.
        new = worlds.laps[:, EGO] > statistics["completed_laps"]
        statistics["completed_laps"][:] = worlds.laps[:, EGO]
        if new.any():
            before = np.nan_to_num(statistics["lap_time_s"][new])
            statistics["lap_time_s"][new] = before + (worlds.lap_time[new, EGO] - before) / worlds.laps[new, EGO]
        statistics["overtakes"] += race.places_gained[:, EGO]
        statistics["places_lost"] += race.places_lost[:, EGO]
        statistics["impact_speed_mps"][:] = worlds.impact_speed[:, EGO]
        statistics["opponent_crashes"] += opponent_crashes

    def info(self, outcome: np.ndarray) -> dict[str, Any]:
        """Return what is known of each world, in new arrays; the mask `_key` says for which worlds `key` is known.

        Args:
            outcome: how the last step ended each world's episode, str (worlds,).
        """
        race, worlds, opponents = self._race, self._race.worlds, self._opponents
        info: dict[str, Any] = {
            "outcome": outcome,
            "track": self._track_names[worlds.track],
            "task": self._task.copy(),
            "car": race.cars[:, EGO].copy(),
            "vehicle": to_values(worlds.params).copy(),
            "contact": CONTACTS[worlds.contact[:, EGO]],
            "opponents": opponents.names(),
            "opponent_speed_mps": opponents.top_speed.copy(),
            "laps": worlds.laps[:, EGO].copy(),
            "last_lap_time_s": worlds.lap_time[:, EGO].copy(),
            "time_s": worlds.time.copy(),
            "training_progress": np.full(len(outcome), self._race.training_progress),
            **{name: total.copy() for name, total in self._statistics.items()},
            **{f"{REWARD_PREFIX}{name}": total.copy() for name, total in self._returns.items()},
        }
        known = dict.fromkeys(info, np.ones(len(outcome), bool))
        known["lap_time_s"] = known["last_lap_time_s"] = worlds.laps[:, EGO] > 0
        return {**info, **{f"_{name}": mask for name, mask in known.items()}}


def final_info(info: Mapping[str, Any], over: np.ndarray) -> dict[str, Any]:
    """Return the `info` of a step as the `final_info` of the worlds whose episode is over, bool (worlds,)."""
    names = [name for name in info if not name.startswith("_")]
    return {**{name: info[name] for name in names}, **{f"_{name}": over & info[f"_{name}"] for name in names}}
