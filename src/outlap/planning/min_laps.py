"""The yardstick: the least time in which a vehicle can lap a track."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from outlap.planning.kept import kept, kept_line, path_arrays, path_of
from outlap.planning.limits import Limits
from outlap.planning.path import Path
from outlap.planning.plan import DEFAULT_MARGIN, SPACING
from outlap.planning.speed_profile import lap_time, motor, speed_profiles
from outlap.track.track import Track

DRAWN = ("mu", "a_max", "a_brake", "v_max", "v_switch")  # what counts where it is drawn; of the rest, the middle does
CHECKS = 2  # cars for which a table is compared with a line of their own

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MinLaps:
    """Minimum lap times on a track of all cars in a range.

    The table holds the minimum-time lines of a few of them: of the middle of the range, and of the ends of everything
    that is drawn. Between them it is not times that are interpolated: a car's lap is that of its own fastest speeds on
    the line of the table that is the fastest for it. Such a lap can be driven, and a line that is a little off its
    optimum costs time of second order only.
    """

    lines: tuple[Path, ...]
    error: float  # by what part laps of the table were too long, at worst, for cars with lines of their own; 0: exact

    def of(self, cars: list[Limits]) -> np.ndarray:
        """Of some cars: (n,) [s]."""
        motors, mu = np.array([motor(car) for car in cars]), np.array([[car.mu] for car in cars])
        times = [
            [lap_time(speed, line.spacing) for speed in speed_profiles(line.curvature, line.spacing, motors, mu)]
            for line in self.lines
        ]
        return np.min(times, axis=0)


@lru_cache(maxsize=64)
def min_laps(track: Track, low: Limits, high: Limits) -> MinLaps:
    """The table of a track for all cars between two; kept in memory and on disk.

    Raises OutlapError where no line can be planned.
    """

    def to_arrays(table: MinLaps) -> dict[str, np.ndarray]:
        arrays = {"error": np.array(table.error), "count": np.array(len(table.lines))}
        for number, line in enumerate(table.lines):
            arrays |= path_arrays(line, f"{number}_")
        return arrays

    def from_arrays(saved: Mapping[str, np.ndarray]) -> MinLaps:
        lines = tuple(path_of(saved, f"{number}_") for number in range(int(saved["count"])))
        return MinLaps(lines, float(saved["error"]))

    key = ["laps", track.fingerprint, asdict(low), asdict(high), DEFAULT_MARGIN]
    return kept(key, lambda: _make(track, low, high), to_arrays, from_arrays)


def _make(track: Track, low: Limits, high: Limits) -> MinLaps:
    from outlap.planning.min_time import MinTimeProblem, spacing_for  # CasADi: not before it is needed

    ends = asdict(low), asdict(high)
    middle = Limits(**{name: 0.5 * (ends[0][name] + ends[1][name]) for name in ends[0]})
    line = kept_line(track, middle).path
    drawn = [name for name in DRAWN if getattr(low, name) < getattr(high, name)]
    if "a_max" in drawn and "a_brake" in drawn:
        drawn.remove("a_brake")  # a car brakes as hard as it accelerates
    if not drawn:
        return MinLaps((line,), 0.0)
    log.info("planning %d lines of %s for the cars that are drawn", 2 * len(drawn) + CHECKS, track.name)
    problem = MinTimeProblem(track, line.resampled(spacing_for(line)), middle, DEFAULT_MARGIN)

    def car(shares: Mapping[str, float]) -> Limits:
        """Of the middle, but for what is this share of the way from low to high."""
        values = {name: (1.0 - x) * getattr(low, name) + x * getattr(high, name) for name, x in shares.items()}
        if "a_max" in values:
            values["a_brake"] = values["a_max"]
        return replace(middle, **values)

    def solved(limits: Limits) -> Path:
        return problem.solve(limits).resampled(SPACING)

    ends = [solved(car({name: end})) for name in drawn for end in (0.0, 1.0)]
    table = MinLaps((line, *ends), 0.0)
    checks = [car(dict(zip(drawn, x, strict=True))) for x in np.random.default_rng(0).random((CHECKS, len(drawn)))]
    own = np.array([MinLaps((solved(check),), 0.0).of([check])[0] for check in checks])
    return replace(table, error=max(0.0, float(np.max(table.of(checks) / own - 1.0))))
