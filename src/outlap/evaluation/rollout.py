"""Racing a driver in a fixed set of episodes: from a driver and tracks to rows, one an episode.

Which episodes are raced is settled before the first step: so many on each track, each with its own seed, and
each is raced to its end. How many worlds race at once changes nothing but the time that it takes. To stop at
a number of steps, or to take the first N episodes that end, would favour short ones, which are crashes.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.drivers.find import find_drivers
from outlap.envs.actions import driver_actions
from outlap.envs.observations import check_terms
from outlap.envs.race import EGO, Race
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.envs.rewards import CURRICULA_OVER, RewardConfig, weighted_terms
from outlap.envs.terminations import CRASH, TerminationConfig
from outlap.errors import OutlapError
from outlap.planning.limits import CarLimits
from outlap.planning.min_laps import min_laps
from outlap.simulator.vehicle import parameter_bounds, parameter_names, to_records
from outlap.track.catalog import load_tracks
from outlap.track.track import Track

log = logging.getLogger(__name__)

DEFAULT_WORLDS = 128
CRAWL = 1.0  # [m/s] mean speed at which the default time limit still allows all laps and the way to the line
VEHICLE = "vehicle"  # in a row while its episode is raced: the ego's parameters
IDLE = -1  # the episode of a world that has none left


@dataclass(frozen=True)
class EvaluationProgress:
    """How far an evaluation has come."""

    total: int  # episodes
    finished: int
    done: float  # episodes, a running one counted by the share of its laps or time that is behind it
    steps: int  # actions taken


def standing_starts(
    env: RaceConfig, tracks: Sequence[Track], laps: int = 3, time_limit: float | None = None
) -> RaceConfig:
    """A task as it is evaluated: from a standstill anywhere on the lap, until the laps are done.

    Cars, sensors, actions and rewards stay those of `env`; where cars are put and how an episode ends do not,
    so that policies are compared on the same episodes however they were trained.

    Args:
        env: what the policy was trained on.
        tracks: to evaluate on.
        laps: to complete from line to line; 0 for no end but the time limit.
        time_limit: [s]; by default enough for `laps` + 1 laps of the longest track at 1 m/s.

    Raises OutlapError for neither laps nor a time limit.
    """
    if time_limit is None:
        if laps == 0:
            raise OutlapError("laps is 0; a time limit is needed then")
        time_limit = (laps + 1) * max(track.centerline.length for track in tracks) / CRAWL
    changes = {
        "tracks": tuple(track.name for track in tracks),
        "augment_tracks": False,
        "start": StartConfig(anywhere=True, speed=0.0, gap=env.start.gap, formation=env.start.formation),
        "termination": TerminationConfig(laps=laps, time_limit=time_limit),
    }
    return env.model_copy(update=changes)


def made_for(driver: Driver, env: RaceConfig) -> RaceConfig:
    """A task with the scanner and the car that a driver was trained with, as far as it says so."""
    changes: dict[str, Any] = {}
    if driver.beams is not None:
        changes["beams"] = driver.beams
    if driver.speeds is not None:
        vehicle = env.vehicle.model_copy(update={"v_max": driver.speeds[1]})
        changes |= {"vehicle": vehicle, "speed_range": driver.speeds}
    return env.model_copy(update=changes)


def episode_seeds(seed: int, track: str, episodes: int) -> np.ndarray:
    """The seeds of a track's episodes: int64 (episodes,), the first ones the same however many there are."""
    key = zlib.crc32(track.encode())
    words = [np.random.SeedSequence((seed, key, k)).generate_state(1)[0] for k in range(episodes)]
    return np.array(words, np.int64)


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
        relative to what was hit), opponent_crashes, one column for each of the ego's parameters that
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
        found, track_steps = _race(driver, env_config, track, seeds[track.name], num_worlds, watch)
        rows += _with_lap_time_ratios(found, track, env_config, lap_time_ratios)
        steps += track_steps
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


def _race(
    driver: Driver,
    config: RaceConfig,
    track: Track,
    seeds: np.ndarray,
    num_worlds: int,
    watch: Callable[[int, float, int], None],
) -> tuple[list[dict[str, Any]], int]:
    """Every episode of one track: its rows, and the steps that they took."""
    worlds = min(num_worlds, len(seeds))
    task, opponents = episode_task(driver, config)
    env = RaceVectorEnv(worlds, task, [track], opponents, autoreset_mode=AutoresetMode.DISABLED)
    score = _Score(config.reward, task.reward, worlds)
    driver.check(env.single_observation_space)
    drawn = drawn_parameters(config)
    drawn_speeds = range(1, config.num_cars if isinstance(config.opponent_speed, tuple) else 1)
    length = track.centerline.length
    rows: dict[int, dict[str, Any]] = {}
    racing = np.arange(worlds)  # the episode of each world
    upcoming = worlds
    observation, _ = env.reset(seed=seeds[:worlds].tolist())
    driver.begin(np.ones(worlds, bool))
    start = env.race.start[:, EGO].copy()
    steps = 0
    while len(rows) < len(seeds):
        env.training_steps = CURRICULA_OVER
        observation, rewards, terminated, truncated, info = env.step(driver_actions(driver, observation, worlds))
        steps += int((racing != IDLE).sum())
        over = terminated | truncated
        last, returns = score.step(env.race, rewards, info)
        for world in np.flatnonzero(over & (racing != IDLE)).tolist():
            episode = int(racing[world])
            rows[episode] = {
                "track": track.name,
                "episode": episode,
                "seed": int(seeds[episode]),
                "driver": driver.name,
                **_row(info, world),
                "terminated": bool(terminated[world]),
                "truncated": bool(truncated[world]),
                "episode_return": float(returns[world]),
                "last_reward": float(last[world]),
                "start_m": float(start[world] % length),
                **{name: float(info["vehicle"][world, EGO, column]) for name, column in drawn.items()},
                **{f"opponent_{i}": str(info["opponents"][world, i - 1]) for i in range(1, config.num_cars)},
                **{f"opponent_{i}_speed_mps": float(info["opponent_speed_mps"][world, i - 1]) for i in drawn_speeds},
                VEHICLE: info["vehicle"][world, EGO].copy(),
            }
        if over.any():
            again: list[int | None] = [None] * worlds  # an idle world goes on with a stream of its own
            for world in np.flatnonzero(over):
                racing[world] = upcoming if upcoming < len(seeds) else IDLE
                if racing[world] != IDLE:
                    again[world] = int(seeds[upcoming])
                    upcoming += 1
            observation, info = env.reset(seed=again, options={"reset_mask": over})
            driver.begin(over)
            score.begin(over)
            start[over] = env.race.start[over, EGO]
        watch(len(rows), len(rows) + _underway(config, length, start, info, racing != IDLE), steps)
    return [rows[episode] for episode in range(len(seeds))], steps


def _with_lap_time_ratios(
    rows: list[dict[str, Any]], track: Track, config: RaceConfig, wanted: bool
) -> list[dict[str, Any]]:
    """The rows of a track with what their laps compare to, in place of the vehicles."""
    vehicles = [row.pop(VEHICLE) for row in rows]
    least, error = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    lapped = np.array([row["completed_laps"] > 0 for row in rows])
    if wanted and lapped.any():
        try:
            table = min_laps(track, config.vehicle)
        except OutlapError as problem:  # of the yardstick alone: what was raced is worth no less
            log.warning("no lap_time_ratio: %s", problem)
        else:
            cars = [
                CarLimits.of_record(to_records(vehicle)) for vehicle, lap in zip(vehicles, lapped, strict=True) if lap
            ]
            least[lapped], error[lapped] = table.of(cars), table.error
    for row, seconds, part in zip(rows, least.tolist(), error.tolist(), strict=True):
        row |= {"min_lap_time_s": seconds, "lap_time_ratio": row["lap_time_s"] / seconds, "min_lap_error": part}
    return rows


def episode_task(driver: Driver, config: RaceConfig) -> tuple[RaceConfig, list[Driver]]:
    """Return a task as this driver needs it, on one track, and its opponents.

    Raises OutlapError for an observation term that does not exist, and for opponents that cannot be loaded.
    """
    check_terms(driver.observation_terms, driver.name)
    opponents: list[Driver] = []
    if config.num_cars > 1:
        opponents = find_drivers(config.opponents, config.field_of_view, config.opponent_split, config.opponent_code)
    shown = driver.reward or config.reward
    assert isinstance(shown, RewardConfig)
    changes: dict[str, Any] = {
        "augment_tracks": False,  # the track that was named, not one of its variants
        "observation": tuple(driver.observation_terms),
        "scale_observations": driver.scale_observations,
        "reward": shown.without_curricula(),
    }
    if not any("scan" in each.observation_terms for each in (driver, *opponents)):
        changes["beams"] = 0  # nobody looks
    return config.model_copy(update=changes), opponents


def single_race(driver: Driver, config: RaceConfig, track: Track) -> RaceVectorEnv:
    """One world as `evaluate` has it for a driver, with the task's scanner even where nobody looks: for pictures.

    Raises OutlapError for a task that the driver does not take.
    """
    task, opponents = episode_task(driver, config)
    task = task.model_copy(update={"beams": config.beams})
    env = RaceVectorEnv(1, task, [track], opponents, autoreset_mode=AutoresetMode.DISABLED)
    driver.check(env.single_observation_space)
    return env


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
        last = np.zeros(len(self.returns)) + sum(weighted_terms(race, EGO, self.config, self.weights).values())
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


def drawn_parameters(config: RaceConfig) -> dict[str, int]:
    """Those of a car's parameters that are ranges: the name of each in a row, and its `vehicle` column."""
    low, high = parameter_bounds(config.vehicle, config.actuators, config.lidar)
    return {name: column for column, name in enumerate(parameter_names()) if low[column] < high[column]}
