"""The yardstick: the least time in which a vehicle can lap a track."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from outlap.errors import OutlapError
from outlap.planning.corridor import wall_margin
from outlap.planning.limits import CarLimits
from outlap.planning.line_cache import cached, cached_line, path_arrays, path_of
from outlap.planning.path import ClosedPath
from outlap.planning.plan import DEFAULT_MARGIN, SPACING, plan_line
from outlap.planning.speed_profile import lap_time, motor, speed_profiles
from outlap.simulator.vehicle import to_records
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

    lines: tuple[ClosedPath, ...]
    error: float  # the largest part by which the laps of CHECKS cars were longer than on lines of their own; 0: one car

    def of(self, cars: Sequence[CarLimits]) -> np.ndarray:
        """Of some cars: (n,) [s]."""
        motors, mu = np.array([motor(car) for car in cars]), np.array([[car.mu] for car in cars])
        times = [
            [lap_time(speed, line.spacing) for speed in speed_profiles(line.curvature, line.spacing, motors, mu)]
            for line in self.lines
        ]
        return np.min(times, axis=0)


def min_laps(track: Track, ends: tuple[np.ndarray, np.ndarray], model: str) -> MinLaps:
    """Return the table of a track for all cars in a range; it is kept on disk.

    Of what is neither friction nor motor (size, wheelbase, steering) the middle counts.

    Args:
        track: to lap.
        ends: the smallest and the largest value of each parameter of a car, (N_PARAMS,) each.
        model: of `SimulatorConfig`.

    Raises OutlapError where no line can be planned for the middle of the ranges.
    """
    low, high = _extremes(ends, model)
    tied = model != "nonlinear_single_track"  # brakes and motor are drawn as one, a_max
    middle = CarLimits.of_record(to_records(np.mean(ends, axis=0)), model)

    def plan() -> dict[str, np.ndarray]:
        table = _table(track, low, middle, high, tied)
        arrays = {"error": np.array(table.error), "count": np.array(len(table.lines))}
        for number, line in enumerate(table.lines):
            arrays |= path_arrays(line, f"{number}_")
        return arrays

    key = ["laps", track.fingerprint, *map(asdict, (low, middle, high)), DEFAULT_MARGIN]
    saved = cached(key if tied else [*key, model], plan)
    lines = tuple(path_of(saved, f"{number}_") for number in range(int(saved["count"])))
    return MinLaps(lines, float(saved["error"]))


def _extremes(ends: tuple[np.ndarray, np.ndarray], model: str) -> tuple[CarLimits, CarLimits]:
    """The smallest and the largest value of each limit; a ratio of two parameters is smallest at opposite ends."""
    low, high = (to_records(np.array(values)) for values in ends)
    corners: list[CarLimits] = []
    for force, mass, power in itertools.product((low, high), repeat=3):
        record = low.copy()
        record["motor_force"], record["brake_force"] = force["motor_force"], force["brake_force"]
        record["m"], record["motor_power"] = mass["m"], power["motor_power"]
        corners.append(CarLimits.of_record(record, model))
    extremes: list[CarLimits] = []
    for record, chosen in ((low, min), (high, max)):
        ratios = {name: chosen(getattr(each, name) for each in corners) for name in ("a_max", "a_brake", "v_switch")}
        limits = CarLimits.of_record(record, model)
        extremes.append(replace(limits, **ratios) if model == "nonlinear_single_track" else limits)
    return extremes[0], extremes[1]


def _table(track: Track, low: CarLimits, middle: CarLimits, high: CarLimits, tied: bool) -> MinLaps:
    line = cached_line(track, middle).path
    drawn = [name for name in DRAWN if getattr(low, name) < getattr(high, name)]
    if tied and "a_brake" in drawn:
        drawn.remove("a_brake")
    if not drawn:
        return MinLaps((line,), 0.0)
    log.info("%s: planning %d more lines for the cars that are drawn", track.name, 2 * len(drawn) + CHECKS)

    def car(shares: Mapping[str, float]) -> CarLimits:
        """Of the middle, but for what is this share of the way from low to high."""
        values = {name: (1.0 - x) * getattr(low, name) + x * getattr(high, name) for name, x in shares.items()}
        if tied and "a_max" in values:
            values["a_brake"] = values["a_max"]
        return replace(middle, **values)

    table = MinLaps((line, *_lines_about(line, track, [car({name: x}) for name in drawn for x in (0.0, 1.0)])), 0.0)
    checks = [car(dict(zip(drawn, x, strict=True))) for x in np.random.default_rng(0).random((CHECKS, len(drawn)))]
    own = [plan_line(track, check).lap_time for check in checks]
    return replace(table, error=max(0.0, float(np.max(table.of(checks) / own - 1.0))))


def _lines_about(line: ClosedPath, track: Track, cars: Sequence[CarLimits]) -> list[ClosedPath]:
    """The minimum-time lines of cars about a line nearby, as far as they are found and free of walls."""
    from outlap.planning.min_time import MinTimeProblem, spacing_for  # CasADi: not before it is needed

    problem = MinTimeProblem(track, line.resampled(spacing_for(line)), cars[0], DEFAULT_MARGIN)
    lines = []
    for limits in cars:
        try:
            found = problem.solve(limits).resampled(SPACING)
        except OutlapError as error:  # the table has one line less, and its error tells what that costs
            log.warning("left out of the table of lap times: %s", error)
            continue
        if wall_margin(track, found, limits).min() > 0.0:
            lines.append(found)
    return lines
