"""Hypothesis strategies: any car that a configuration accepts, on circuits with room, corners and narrow parts."""

from __future__ import annotations

import math
import os
from functools import cache
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from outlap.config import Config
from outlap.simulator.vehicle import (
    ActuatorParams,
    AxleTyres,
    LidarParams,
    PacejkaTyre,
    SensorParams,
    VehicleParams,
    parameter_bounds,
    to_records,
)
from outlap.track.centerline import Centerline
from outlap.track.generate import generate_track
from outlap.track.track import Track
from outlap.track.walls import draw_walls
from synthetic_tracks import ring, yard

PARTS: dict[str, type[Config]] = {
    "vehicle": VehicleParams,
    "axles": AxleTyres,
    "tyre": PacejkaTyre,
    "actuators": ActuatorParams,
    "sensors": SensorParams,
    "lidar": LidarParams,
}
FIELDS = [(part, name) for part, cls in PARTS.items() for name in cls.model_fields if name not in ("axles", "tyre")]
LONGEST_DELAY = 0.05  # [s] of commands and scans, so that the buffers of the tests stay small

shares = st.floats(0.0, 1.0) | st.sampled_from([0.0, 1.0])
# Which fields differ from the default, and where in the accepted range they lie: few, or all of them.
oddities = st.dictionaries(st.sampled_from(FIELDS), shares) | st.fixed_dictionaries(dict.fromkeys(FIELDS, shares))


@cache
def accepted(part: str, name: str) -> tuple[float, float]:
    """The smallest and the largest value of a field that validation lets through, found by asking it."""
    cls = PARTS[part]
    default = float(cls.model_fields[name].default)

    def accepts(value: float) -> bool:
        try:
            cls.model_validate({name: value})
        except ValidationError:
            return False
        return True

    def furthest(end: float) -> float:
        good, bad = _rank(default), _rank(end)
        if accepts(end):
            return end
        while abs(bad - good) > 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if accepts(_ranked(middle)) else (good, middle)
        return _ranked(good)

    largest = float(np.finfo(np.float64).max)
    return furthest(-largest), furthest(largest)


def _rank(value: float) -> int:
    """The number of a float when all are put in order."""
    bits = int(np.float64(abs(value)).view(np.int64))
    return bits if value >= 0.0 else -bits


def _ranked(rank: int) -> float:
    value = float(np.int64(abs(rank)).view(np.float64))
    return value if rank >= 0 else -value


def value_at(part: str, name: str, share: float) -> float:
    """A value of a field's accepted range: 0 is its low end, 1 its high one; even over the orders of magnitude."""
    low, high = accepted(part, name)
    if name.endswith("_delay") or name == "latency":
        high = LONGEST_DELAY
    if share in (0.0, 1.0):
        return high if share else low
    if low > 0.0 or high < 0.0:
        value = math.copysign(math.exp((1 - share) * math.log(abs(low)) + share * math.log(abs(high))), high)
    elif low == 0.0 or high == 0.0:
        value = low * (1 - share) ** 4 + high * share**4
    else:
        around = 2.0 * share - 1.0
        value = (high if around > 0.0 else -low) * around**3
    return min(max(value, low), high)


def car_config(odd: dict[tuple[str, str], Any]) -> dict[str, Any]:
    """The keywords `vehicle`, `actuators`, `sensors` and `lidar` of an environment, from values by (part, field)."""
    fields: dict[str, dict[str, Any]] = {part: {} for part in PARTS}
    for (part, name), value in odd.items():
        fields[part][name] = value
    fields["vehicle"] |= {"axles": fields.pop("axles"), "tyre": fields.pop("tyre")}
    return fields


@st.composite
def rows(draw: st.DrawFn) -> np.ndarray:
    """The parameters of any car."""
    config = car_config({field: value_at(*field, share) for field, share in draw(oddities).items()})
    values, _ = parameter_bounds(
        VehicleParams.model_validate(config["vehicle"]),
        ActuatorParams.model_validate(config["actuators"]),
        LidarParams.model_validate(config["lidar"]),
        SensorParams.model_validate(config["sensors"]),
    )
    return to_records(values)


@cache
def angular(resolution: float = 0.05) -> Track:
    """A square with sharp corners whose sides narrow to 0.8 m by turns."""
    corners = np.array([[5.0, -5.0], [5.0, 5.0], [-5.0, 5.0], [-5.0, -5.0]])
    along = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None]
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    points = np.roll(np.concatenate(sides), -10, axis=0)
    half_width = np.where(np.arange(len(points)) % 20 < 3, 0.4, 1.2)
    line = Centerline.from_points(points, half_width, half_width)
    occupancy, origin = draw_walls(line, resolution, 0.3)
    return Track("angular", occupancy, resolution, origin, line)


@cache
def circuits() -> tuple[Track, ...]:
    """Few, so that every example can have all of them."""
    generated = [generate_track(seed, length=45.0 + 10 * seed, width=2.0, resolution=0.1) for seed in (1, 2, 3)]
    return (ring(4.0, resolution=0.1, yaw=0.7), yard(12.0), angular(), *generated)


# OUTLAP_EXAMPLES=5000 looks for new failures for as long; without it, the tests repeat themselves.
_examples = os.environ.get("OUTLAP_EXAMPLES")
campaign = settings(
    max_examples=int(_examples or 25),
    deadline=None,
    derandomize=_examples is None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
