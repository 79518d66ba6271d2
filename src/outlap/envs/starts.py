"""Where the cars of a race are put: start formations."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from outlap.config import Config, Number, bounded, bounds
from outlap.envs.race import EGO
from outlap.errors import OutlapError
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING, Atlas
from outlap.simulator.collision import FREE
from outlap.simulator.seeding import START_STREAM, uniform
from outlap.simulator.simulator import Simulator

START_ATTEMPTS = 20
MARGIN = 0.1  # [m] that a start leaves at least between the car and the track's edge, or the next car
GAP, ORDER, SIDE, HEADING, SPEED = range(5)  # what is drawn for each car


class StartConfig(Config):
    """Where and how cars are put on the track.

    Formations: `queue`, one behind another in random order; `behind`, a queue that the ego is the last of; `grid`, a
    queue whose cars stand left and right by turns; `scattered`, at random places of the lap.
    """

    formation: Literal["queue", "behind", "grid", "scattered"] = "queue"
    anywhere: bool = True  # at a random arc length; otherwise the ego is put on the start line
    speed: Number = 0.0  # of every car [m/s]
    offset: float = Field(default=0.5, ge=0, le=1)  # largest, as a share of the room to the track's edge; a grid's own
    heading_error: float = Field(default=0.1, ge=0)  # largest [rad]
    gap: Annotated[Number, bounded(at_least=0)] = (1.5, 4.0)  # along the track [m]; between scattered cars the smaller


def reset_worlds(
    config: StartConfig,
    simulator: Simulator,
    which: np.ndarray,
    keys: np.ndarray,
    episodes: np.ndarray,
    tracks: np.ndarray,
    params: np.ndarray,
    road: np.ndarray | None = None,
) -> None:
    """Reset some worlds to starts at which no car touches anything; redraw those of a world until there is none.

    Args:
        config: the formation.
        simulator: whose worlds to reset.
        which: (n,) numbers of the worlds.
        keys: uint64 (n,) of the worlds.
        episodes: (n,) number of each world's episode.
        tracks: (n,) numbers in the atlas.
        params: of the cars, (n, cars).
        road: friction along the lap, see `Simulator.reset`.

    Raises OutlapError for a track on which no such start is found.
    """
    noise_keys = keys ^ (episodes.astype(np.uint64) << np.uint64(32))
    waiting = np.arange(len(which))
    for attempt in range(START_ATTEMPTS):
        # The later the attempt, the nearer to the centreline: a narrow place ends the loop all the same.
        spread = 1.0 - attempt / (START_ATTEMPTS - 1)
        draws = episodes[waiting] * START_ATTEMPTS + attempt
        starts = draw_starts(config, simulator.atlas, keys[waiting], draws, tracks[waiting], params[waiting], spread)
        simulator.reset(
            which[waiting], keys=noise_keys[waiting], tracks=tracks[waiting], params=params[waiting], starts=starts,
            road=None if road is None else road[waiting],
        )  # fmt: skip
        waiting = waiting[(simulator.worlds.contact[which[waiting]] != FREE).any(axis=1)]
        if not len(waiting):
            return
    name = simulator.tracks[tracks[waiting[0]]].name
    raise OutlapError(f"track {name}: found no start free of contact; is it as wide as a car, and long enough for all?")


def draw_starts(
    config: StartConfig,
    atlas: Atlas,
    keys: np.ndarray,
    draws: np.ndarray,
    tracks: np.ndarray,
    params: np.ndarray,
    spread: float,
) -> np.ndarray:
    """Places to put the cars of some worlds; they may touch something, which `Simulator.reset` finds.

    Args:
        config: the formation.
        atlas: the tracks.
        keys: uint64 (n,) of the worlds.
        draws: (n,) numbers that differ from draw to draw.
        tracks: (n,) numbers in the atlas.
        params: PARAMETERS (n, cars).
        spread: 0 … 1 of the configured offsets and heading errors.

    Returns:
        (n, cars, 4) arc length [m], offset to the left [m], heading error [rad], speed [m/s].
    """
    cars = params.shape[1]
    share = uniform(keys, draws, START_STREAM, 1 + 5 * cars)
    each = share[:, 1:].reshape(len(keys), cars, 5)
    rows, spacing = atlas.index[tracks, ROWS, None], atlas.frame[tracks, SPACING, None]
    length = rows * spacing
    if config.formation == "scattered":
        behind = _scattered(each[..., GAP], params["length"] + max(bounds(config.gap)[0], MARGIN), length)
    else:
        behind = _queued(config, each, params["length"])
    base = share[:, :1] * length if config.anywhere else np.zeros((len(keys), 1))
    s = base - behind
    row = atlas.index[tracks, FIRST_ROW, None] + (s / spacing).astype(np.int64) % rows
    # The body's half diagonal stays on the track whichever way the car points.
    body = 0.5 * np.hypot(params["length"], params["width"]) + MARGIN
    side = 2.0 * each[..., SIDE] - 1.0
    if config.formation == "grid":
        side = 1.0 - 2.0 * (_places(behind) % 2)
    room = np.where(side > 0.0, atlas.line["width_left"][row], atlas.line["width_right"][row]) - body
    offset = side * np.maximum(room, 0.0) * config.offset * spread
    error = (2.0 * each[..., HEADING] - 1.0) * config.heading_error * spread
    low, high = bounds(config.speed)
    speed = np.clip(low + each[..., SPEED] * (high - low), params["v_min"], params["v_max"])
    return np.stack([s, offset, error, speed], axis=-1)


def _places(values: np.ndarray) -> np.ndarray:
    """The place of every car, 0 for the smallest value of its world: int (n, cars)."""
    return np.argsort(np.argsort(values, axis=1), axis=1)


def _queued(config: StartConfig, each: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """How far behind the ego each car of a queue stands, negative before it: (n, cars) [m]."""
    order = each[..., ORDER].copy()
    if config.formation == "behind":
        order[:, EGO] = np.inf
    low, high = bounds(config.gap)
    gaps = np.cumsum(np.maximum(low + each[..., GAP] * (high - low), MARGIN), axis=1)
    behind = np.empty_like(gaps)
    by_place = np.argsort(order, axis=1)
    lengths = np.take_along_axis(lengths, by_place, axis=1)
    np.put_along_axis(behind, by_place, gaps + np.cumsum(lengths, axis=1) - 0.5 * lengths, axis=1)
    return behind - behind[:, [EGO]]


def _scattered(share: np.ndarray, slots: np.ndarray, length: np.ndarray) -> np.ndarray:
    """How far behind the ego each car stands, by the shorter way round: (n, cars) [m].

    What the cars' slots leave of the lap is cut at uniform places: all arrangements without overlap are as likely.
    """
    order = np.argsort(share, axis=1)
    slots = np.take_along_axis(slots, order, axis=1)
    free = np.maximum(length - slots.sum(axis=1, keepdims=True), 0.0)
    taken = np.cumsum(slots, axis=1) - 0.5 * slots
    s = np.empty_like(share)
    np.put_along_axis(s, order, np.sort(share, axis=1) * free + taken, axis=1)
    behind = s[:, [EGO]] - s
    return behind - length * np.rint(behind / length)
