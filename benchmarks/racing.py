"""Measure races against opponents: actions of the first car per second, simulator and opponents together.

The first car holds random actions. Its episode restarts when it crashes, and the time for that counts.

    python benchmarks/racing.py --json racing.json
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tyro.conf import FlagCreatePairsOff

from outlap.envs.keywords import make_race_vector
from outlap.files import atomic_write, to_json
from outlap.provenance import machine

HOLD = 10  # actions that a random one is held
PLANS = 64  # random actions, made beforehand


@dataclass(frozen=True)
class Settings:
    """What is measured."""

    opponents: tuple[str, ...] = ("population",)
    """Drivers and populations; the training half of the one that comes with outlap by default."""

    opponent_code: FlagCreatePairsOff[bool] = False
    """Import modules for opponents, module:function, which runs their code."""

    worlds: int = 128
    """Races in lock-step."""

    cars: int = 2
    """In every race, two or more."""

    beams: int = 108
    """LiDAR beams."""

    control_interval: int = 4
    """Physics steps per action."""

    tracks: tuple[str, ...] = ()
    """Names or map folders; the built-in training circuits by default."""

    seconds: float = 5.0
    """Of a measurement."""

    repeats: int = 3
    """Measurements; the median is reported, with the fastest and the slowest."""

    json: Path | None = None
    """Write the result as JSON to this file too."""


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    env = make_race_vector(
        settings.worlds, tracks=settings.tracks, num_cars=settings.cars, beams=settings.beams,
        control_interval=settings.control_interval, opponents=settings.opponents, opponent_code=settings.opponent_code,
        scale_observations=True, observation=("scan", "vel", "heading", "previous_action"), speed_range=(0.0, 8.0),
    )  # fmt: skip
    env.reset(seed=0)
    plans = np.random.default_rng(0).uniform([-0.3, -1.0], [0.3, 0.5], (PLANS, settings.worlds, 2)).astype(np.float32)
    rates = []
    for repeat in range(1 + settings.repeats):  # the first one compiles
        steps, begin = 0, time.perf_counter()
        while time.perf_counter() - begin < settings.seconds:
            env.step(plans[(steps // HOLD + repeat) % PLANS])
            steps += 1
        rates.append(steps * settings.worlds / (time.perf_counter() - begin))
    median, slowest, fastest = (round(float(take(rates[1:]))) for take in (np.median, min, max))
    opponents = [driver.name for driver in env.opponents.drivers]
    if settings.json:
        row = {
            "cars": settings.cars, "beams": settings.beams, "worlds": settings.worlds,
            "control_interval": settings.control_interval, "opponents": opponents, "ego_steps_per_second": median,
            "slowest_ego_steps_per_second": slowest, "fastest_ego_steps_per_second": fastest,
        }  # fmt: skip
        atomic_write(settings.json, to_json({"rows": [row], "machine": machine()}) + "\n")
    print(
        f"{settings.worlds} races of {settings.cars} cars, {settings.beams} beams, {len(opponents)} opponents to draw "
        f"from: {median:,} actions of the first car a second ({slowest:,} … {fastest:,})"
    )


if __name__ == "__main__":
    main()
