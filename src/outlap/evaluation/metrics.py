"""From rows, one an episode, to the summary of an evaluation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from outlap.envs.terminations import CRASH, FINISHED, STALLED, TIMEOUT
from outlap.evaluation.statistics import estimate_mean, wilson_interval

OUTCOMES = (CRASH, FINISHED, TIMEOUT, STALLED)
MEANS = (
    "completed_laps", "lap_time_s", "lap_time_ratio", "mean_speed_mps", "progress_m", "episode_steps", "episode_return",
)  # fmt: skip
METHOD_MEANS = ("crash_rate", "mean_speed_mps", "lap_time_ratio", "progress_m")


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """What an evaluation found, for all episodes together and for each track.

    Every number is over episodes of one policy: its interval says how well that policy's mean on these
    tracks is known, not how far another training of the same method would differ. An episode counts once,
    however long it was; `lap_time_s` is over the episodes with at least one completed lap, each with the
    mean of its laps, since laps of one car in one episode are not independent. The intervals under `all`
    take the episodes as one sample, which makes them wide where tracks differ.

    Args:
        rows: of `evaluate`.

    Returns:
        {"all": summary, "tracks": {name: summary}}. A summary has the number of `episodes`, `crash_rate` with
        its Wilson interval `crash_rate_low` … `crash_rate_high`, the total `overtakes` and `places_lost`, how
        many episodes had which of the `outcomes`, with what the ego made `contacts`, how often an opponent crashed
        (`opponent_crashes`), by what part the least lap times may be too long (`min_lap_error`), and for each of MEANS
        a {mean, sd, low, high} with the 95 % interval of the mean. What is not known is None.
    """
    tracks = rows.groupby("track", sort=False)  # in the order of the evaluation
    return {"all": _summary(rows), "tracks": {str(name): _summary(group) for name, group in tracks}}


def summarise_methods(rows: pd.DataFrame) -> dict[str, Any]:
    """Crash rate, speed and progress of each method, over all tracks and by track; the adaptation seed is the unit.

    Args:
        rows: of episodes, with `method` and `adaptation_seed`.

    Returns:
        method → {"all": …, "tracks": {name: …}}, each with `crash_rate`, `mean_speed_mps`, `lap_time_ratio` (of the
        episodes with a lap) and `progress_m` as {mean, sd, low, high}; `before` has one seed, and no interval.
    """
    rows = rows.assign(crash_rate=(rows["outcome"] == CRASH).astype(float))

    def of(chosen: pd.DataFrame) -> dict[str, Any]:
        seeds = chosen.groupby("adaptation_seed")
        means = {name: np.asarray(seeds[name].mean(), np.float64) for name in METHOD_MEANS}  # NaN left out
        return {"episodes": len(chosen), "seeds": len(seeds), **{name: _mean(mean) for name, mean in means.items()}}

    return {
        str(method): {"all": of(mine), "tracks": {track: of(part) for track, part in mine.groupby("track", sort=False)}}
        for method, mine in rows.groupby("method", sort=False)
    }


def _summary(rows: pd.DataFrame) -> dict[str, Any]:
    episodes = len(rows)
    ended = rows["outcome"].to_numpy()
    outcomes = {outcome: int(np.count_nonzero(ended == outcome)) for outcome in OUTCOMES}
    crashes = outcomes[CRASH]
    low, high = wilson_interval(crashes, episodes)
    return {
        "episodes": episodes,
        "crash_rate": crashes / episodes if episodes else None,
        "crash_rate_low": _or_none(low),
        "crash_rate_high": _or_none(high),
        "overtakes": int(rows["overtakes"].to_numpy().sum()),
        "places_lost": int(rows["places_lost"].to_numpy().sum()),
        "outcomes": outcomes,
        "contacts": {kind: int(np.count_nonzero(rows["contact"] == kind)) for kind in ("wall", "car")},
        "opponent_crashes": int(rows["opponent_crashes"].to_numpy().sum()),
        "min_lap_error": _or_none(float(np.fmax.reduce(rows["min_lap_error"].to_numpy(np.float64), initial=np.nan))),
        **{name: _mean(rows[name].to_numpy()) for name in MEANS},
    }


def _mean(values: np.ndarray) -> dict[str, float | None]:
    estimate = estimate_mean(values[~np.isnan(values)])
    return {name: _or_none(value) for name, value in estimate._asdict().items()}


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
