"""Race a driver in a fixed set of episodes: one row for each episode.

The episodes are chosen before the first step: a number of them on each track, each with its own seed, and each is
raced to its end. The number of worlds that race at once changes nothing but the time that it takes. To stop at a number
of steps, or to take the first N episodes that end, would favour short ones, which are crashes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.envs.actions import driver_actions
from outlap.envs.race import EGO, Race
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.rewards import CURRICULUM_END, RewardConfig, scaled_terms, weighted_terms
from outlap.envs.terminations import CRASH
from outlap.errors import OutlapError
from outlap.evaluation.protocol import car_ends, drawn_parameters, episode_seeds, episode_task
from outlap.planning.limits import CarLimits
from outlap.planning.min_laps import min_laps
from outlap.simulator.vehicle import to_records
from outlap.simulator.worlds import ARC_LENGTH, OFFSET
from outlap.track.catalog import load_tracks
from outlap.track.track import Track

log = logging.getLogger(__name__)

DEFAULT_WORLDS = 128
VEHICLE = "vehicle"  # in a row while its episode is raced: the ego's parameters
IDLE = -1  # the episode of a world that has none left


@dataclass(frozen=True)
class EvaluationProgress:
    """How far an evaluation has come."""

    total: int  # episodes
    finished: int
    done: float  # episodes, a running one counted by the share of its laps or time that is behind it
    steps: int  # actions taken


def evaluate(
    driver: Driver,
    env_config: RaceConfig,
    tracks: Sequence[str | Track],
    episodes: int,
    seed: int,
    num_worlds: int = DEFAULT_WORLDS,
    on_progress: Callable[[EvaluationProgress], None] | None = None,
    lap_time_ratios: bool = True,
) -> pd.DataFrame:
    """Race `driver` in `episodes` episodes on each track.

    Nothing is learnt, and reward curricula are taken at their end. Returns are of the task's reward; a driver that
    observes rewards is shown those that it was trained with, whatever the task's are. An episode can be raced again
    with `make_race(tracks=[track], ...).reset(seed=...)` and its row's seed.

    Args:
        driver: of the first car.
        env_config: the task; its tracks are not used, its observation and scaling are replaced by the driver's.
        tracks: names, map folders or tracks.
        episodes: on each track.
        seed: from which that of each episode is made; equal seeds give the same episodes to every driver.
        num_worlds: raced at once; changes the time, and not the rows (those of a stochastic policy excepted).
        on_progress: called after every step.
        lap_time_ratios: compare laps with the least time in which they can be driven; lines are planned for that once
            a track, some ten seconds each, where an episode has a lap.

    Returns:
        A row an episode, in the order of the tracks and of their seeds: track, episode (its number), seed,
        driver, outcome, terminated, truncated, episode_steps, duration_s, episode_return, last_reward,
        overtakes, places_lost, completed_laps, lap_time_s (mean of its laps, NaN without one), min_lap_time_s (of the
        ego's very vehicle on this track, see `planning.min_laps`; NaN in an episode without a lap), lap_time_ratio (of
        the two before), min_lap_error (part by which the second may be too long), start_m (arc length), progress_m,
        mean_speed_mps, contact (what the ego hit: wall, car or nothing), impact_speed_mps (NaN without a crash,
        relative to what was hit), crash_s_m and crash_d_m (where it was: arc length along the centreline and offset to
        its left, NaN without a crash), opponent_crashes, one column for each of the ego's parameters that
        is drawn, such as vehicle_mu, the driver of each opponent (opponent_1), and its top speed if that is drawn
        (opponent_1_speed_mps).

    Raises OutlapError for tracks that cannot be loaded or share a name, an observation that the driver does
    not take, episodes that may never end.
    """
    loaded = load_tracks(tracks)
    _check_arguments(env_config, loaded, episodes, seed, num_worlds)
    seeds = {track.name: episode_seeds(seed, track.name, episodes) for track in loaded}
    total = episodes * len(loaded)
    rows: list[dict[str, Any]] = []
    steps = 0

    def watch(finished: int, done: float, track_steps: int) -> None:
        if on_progress is not None:
            before = len(rows)
            on_progress(EvaluationProgress(total, before + finished, before + done, steps + track_steps))

    for track in loaded:
        races = _Races(driver, env_config, track, seeds[track.name], num_worlds)
        found = races.run(watch)
        rows += _with_lap_time_ratios(found, track, env_config, lap_time_ratios)
        steps += races.steps
    return pd.DataFrame(rows)


def _check_arguments(config: RaceConfig, tracks: Sequence[Track], episodes: int, seed: int, num_worlds: int) -> None:
    if not tracks:
        raise OutlapError("tracks: none given; at least one is needed")
    names = [track.name for track in tracks]
    for name in names:
        if names.count(name) > 1:
            raise OutlapError(f"tracks: {name} is named twice; results are told apart by the track's name")
    for field, value, least in (("episodes", episodes, 1), ("num_worlds", num_worlds, 1), ("seed", seed, 0)):
        if value < least:
            raise OutlapError(f"{field} is {value}; it must be at least {least}")
    rules = config.termination
    if not rules.time_limit and not (rules.laps and rules.stall_time):
        raise OutlapError("termination: an episode may never end; set a time_limit, or laps and a stall_time")


class _Races:
    """All episodes of one track; a world whose episode has ended starts the next one."""

    def __init__(self, driver: Driver, config: RaceConfig, track: Track, seeds: np.ndarray, num_worlds: int) -> None:
        self.driver, self.config, self.track, self.seeds = driver, config, track, seeds
        worlds = min(num_worlds, len(seeds))
        task, opponents = episode_task(driver, config)
        self.env = RaceVectorEnv(worlds, task, [track], opponents, autoreset_mode=AutoresetMode.DISABLED)
        driver.check(self.env.single_observation_space)
        self.score = _Score(config.reward, task.reward, worlds)
        self.drawn = drawn_parameters(config)
        self.episode = np.arange(worlds)  # of each world
        self.upcoming = worlds  # the next episode
        self.start = np.zeros(worlds)  # arc length [m]
        self.rows: dict[int, dict[str, Any]] = {}  # by episode
        self.steps = 0

    def run(self, watch: Callable[[int, float, int], None]) -> list[dict[str, Any]]:
        """Race all episodes and return their rows; call `watch` after every step with what is done, see `evaluate`."""
        env, driver = self.env, self.driver
        worlds = len(self.episode)
        observation, _ = env.reset(seed=self.seeds[:worlds].tolist())
        driver.begin(np.ones(worlds, bool))
        self.start[:] = env.race.start[:, EGO]
        while len(self.rows) < len(self.seeds):
            observation, rewards, terminated, truncated, info = env.step(driver_actions(driver, observation, worlds))
            self.steps += int((self.episode != IDLE).sum())
            over = terminated | truncated
            last, returns = self.score.step(env.race, rewards, info)
            for world in np.flatnonzero(over & (self.episode != IDLE)).tolist():
                end = {
                    "terminated": bool(terminated[world]),
                    "truncated": bool(truncated[world]),
                    "episode_return": float(returns[world]),
                    "last_reward": float(last[world]),
                }
                self.rows[int(self.episode[world])] = self._row(world, info, end)
            if over.any():
                observation, info = self._begin(over)
            underway = _underway(self.config, self.track.centerline.length, self.start, info, self.episode != IDLE)
            watch(len(self.rows), len(self.rows) + underway, self.steps)
        return [self.rows[episode] for episode in range(len(self.seeds))]

    def _begin(self, worlds: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin the next episodes in some worlds, bool (worlds,); return the observation and the info."""
        seeds: list[int | None] = [None] * len(worlds)  # an idle world draws from a stream of its own
        for world in np.flatnonzero(worlds):
            self.episode[world] = self.upcoming if self.upcoming < len(self.seeds) else IDLE
            if self.episode[world] != IDLE:
                seeds[world] = int(self.seeds[self.upcoming])
                self.upcoming += 1
        observation, info = self.env.reset(seed=seeds, options={"reset_mask": worlds})
        self.driver.begin(worlds)
        self.score.begin(worlds)
        self.start[worlds] = self.env.race.start[worlds, EGO]
        return observation, info

    def _row(self, world: int, info: dict[str, Any], end: dict[str, Any]) -> dict[str, Any]:
        """The row of a world's episode, which has just ended, with the values of its last step."""
        episode, vehicle = int(self.episode[world]), info["vehicle"][world, EGO].copy()
        opponents = range(1, self.config.num_cars)
        drawn_speeds = opponents if isinstance(self.config.opponent_speed, tuple) else ()
        return {
            "track": self.track.name,
            "episode": episode,
            "seed": int(self.seeds[episode]),
            "driver": self.driver.name,
            **_row(info, world),
            **self._crash(world, info),
            **end,
            "start_m": float(self.start[world] % self.track.centerline.length),
            **({"car": int(info["car"][world])} if self.config.cars else {}),
            **{name: float(vehicle[column]) for name, column in self.drawn.items()},
            **{f"opponent_{i}": str(info["opponents"][world, i - 1]) for i in opponents},
            **{f"opponent_{i}_speed_mps": float(info["opponent_speed_mps"][world, i - 1]) for i in drawn_speeds},
            VEHICLE: vehicle,
        }

    def _crash(self, world: int, info: dict[str, Any]) -> dict[str, float]:
        """Where a world's ego is on the track [m], if it crashed."""
        s, d = self.env.race.worlds.frenet[world, EGO, [ARC_LENGTH, OFFSET]].tolist()
        crashed = info["outcome"][world] == CRASH
        return {"crash_s_m": s if crashed else float("nan"), "crash_d_m": d if crashed else float("nan")}


def _with_lap_time_ratios(
    rows: list[dict[str, Any]], track: Track, config: RaceConfig, wanted: bool
) -> list[dict[str, Any]]:
    """The rows of a track with what their laps compare to, in place of the vehicles."""
    vehicles = [row.pop(VEHICLE) for row in rows]
    least, error = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    lapped = np.array([row["completed_laps"] > 0 for row in rows])
    if wanted and lapped.any():
        try:
            table = min_laps(track, car_ends(config), config.model)
        except OutlapError as problem:  # of the yardstick alone: what was raced is worth no less
            log.warning("no lap_time_ratio: %s", problem)
        else:
            cars = [
                CarLimits.of_record(to_records(vehicle), config.model)
                for vehicle, lap in zip(vehicles, lapped, strict=True)
                if lap
            ]
            least[lapped], error[lapped] = table.of(cars), table.error
    for row, seconds, part in zip(rows, least.tolist(), error.tolist(), strict=True):
        row |= {"min_lap_time_s": seconds, "lap_time_ratio": row["lap_time_s"] / seconds, "min_lap_error": part}
    return rows


class _Score:
    """Rewards of a task in races that show the driver another reward."""

    def __init__(self, wanted: RewardConfig, shown: RewardConfig, worlds: int) -> None:
        self.config = wanted.without_curricula()
        self.weights = None if self.config == shown else self.config.resolved()
        self.returns = np.zeros(worlds)

    def step(self, race: Race, rewards: np.ndarray, info: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """The reward of the last step and the return so far: (worlds,) each."""
        if self.weights is None:
            return rewards, info["episode_return"]
        terms = weighted_terms(race, EGO, self.config, self.weights)
        last = np.zeros(len(self.returns)) + sum(scaled_terms(terms, CURRICULUM_END, self.config).values())
        self.returns += last
        return last, self.returns

    def begin(self, worlds: np.ndarray) -> None:
        """Episodes begin in some worlds, bool (worlds,)."""
        self.returns[worlds] = 0.0


def _row(info: dict[str, Any], world: int) -> dict[str, Any]:
    """What the environment says of an episode that just ended."""
    crashed = info["outcome"][world] == CRASH
    return {
        "outcome": str(info["outcome"][world]),
        "episode_steps": int(info["episode_steps"][world]),
        "duration_s": float(info["time_s"][world]),
        "overtakes": int(info["overtakes"][world]),
        "places_lost": int(info["places_lost"][world]),
        "completed_laps": int(info["completed_laps"][world]),
        "lap_time_s": float(info["lap_time_s"][world]),
        "progress_m": float(info["progress_m"][world]),
        "mean_speed_mps": float(info["mean_speed_mps"][world]),
        "contact": str(info["contact"][world]),
        "impact_speed_mps": float(info["impact_speed_mps"][world]) if crashed else float("nan"),
        "opponent_crashes": int(info["opponent_crashes"][world]),
    }


def _underway(config: RaceConfig, length: float, start: np.ndarray, info: dict[str, Any], racing: np.ndarray) -> float:
    """How many episodes' worth of racing the running ones have behind them; less than their number."""
    rules = config.termination
    share = np.zeros(len(racing))
    if rules.time_limit:
        share = info["time_s"] / rules.time_limit
    if rules.laps:
        to_line = length - start % length
        share = np.maximum(share, info["progress_m"] / (to_line + rules.laps * length))
    return float(np.clip(share[racing], 0.0, 0.999).sum())
