"""Friction that varies along the lap: slippery patches, drawn at each reset."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from outlap.config import Config, Number, bounded, bounds
from outlap.simulator.seeding import ROAD_STREAM, uniform

ROAD_BINS = 256  # equal parts of a lap, each with a friction of its own


class RoadConfig(Config):
    """Slippery patches across the whole width of the track, at places that are drawn at each reset."""

    patches: int = Field(default=0, ge=0, le=64)  # per lap
    patch_length: Annotated[Number, bounded(at_least=0.01)] = (1.0, 4.0)  # [m]
    patch_friction: Annotated[Number, bounded(above=0, at_most=1)] = (0.4, 0.8)  # friction / mu [-]

    @property
    def bins(self) -> int:
        """The parts of a lap that have a friction of their own; none without patches."""
        return ROAD_BINS if self.patches else 0


def draw_road(config: RoadConfig, keys: np.ndarray, episodes: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Draw the friction of equal parts of the lap, as a share of a car's `mu`.

    Args:
        config: the patches.
        keys: uint64 (n,) of the worlds.
        episodes: (n,) number of each world's episode.
        lengths: (n,) of the centrelines [m].

    Returns:
        float32 (n, bins): 1 outside of patches; where patches overlap, the lowest.
    """
    road = np.ones((len(keys), config.bins), np.float32)
    if not config.patches:
        return road
    share = uniform(keys, episodes, ROAD_STREAM, 3 * config.patches).reshape(len(keys), config.patches, 3)
    middles = (np.arange(config.bins) + 0.5) / config.bins
    (short, long), (slippery, grippy) = bounds(config.patch_length), bounds(config.patch_friction)
    for patch in range(config.patches):
        place, size, grip = share[:, patch].T
        part = (short + size * (long - short)) / lengths  # of the lap
        inside = (middles - place[:, None]) % 1.0 < part[:, None]
        friction = slippery + grip * (grippy - slippery)
        road = np.where(inside, np.minimum(road, friction[:, None]), road)
    return road.astype(np.float32)
