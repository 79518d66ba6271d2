"""The line to race on each track, and the speed to have on it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from outlap.planning.limits import CarLimits, grip_and_motor
from outlap.planning.line_cache import cached_line
from outlap.planning.path import ClosedPath
from outlap.planning.speed_profile import speed_profile, speed_profiles
from outlap.simulator.atlas import FIRST_ROW, ROWS, SPACING, Atlas
from outlap.track.track import Track

RacingLine = Literal["track", "min-curvature", "min-time"]
"""`track`: the track's own raceline, with its speeds, or else its centreline. Others are planned, see `planning`."""

GRIP_SHARE = 0.8  # that a car on the centreline, which is nobody's racing line, asks for
PROFILE_SPACING = 0.1  # [m] of the points at which a car's own speeds are found
LINE_X, LINE_Y, LINE_SPEED = range(3)  # columns


def racing_lines(tracks: tuple[Track, ...], atlas: Atlas, limits: CarLimits, choice: RacingLine) -> np.ndarray:
    """The racing line beside every row of the atlas: float32 (rows, 3) x [m], y [m], speed [m/s].

    Points of a line are at the arc lengths of the centreline beside which they lie.

    Args:
        tracks, atlas: the tracks.
        limits: of a typical car, for which lines are planned.
        choice: which line.

    Raises OutlapError for a track on which none can be planned.
    """
    out = np.empty((len(atlas.line), 3), np.float32)
    for number, track in enumerate(tracks):
        first, rows = int(atlas.index[number, FIRST_ROW]), int(atlas.index[number, ROWS])
        spacing, here = atlas.frame[number, SPACING], out[first : first + rows]
        if choice == "track" and track.raceline is None:
            middle = atlas.line[first : first + rows]
            here[:, LINE_X], here[:, LINE_Y] = middle["x"], middle["y"]
            here[:, LINE_SPEED] = speed_profile(middle["curvature"], spacing, limits, GRIP_SHARE * limits.mu)
            continue
        line = track.raceline if choice == "track" else cached_line(track, limits, choice).raceline
        assert line is not None
        at, _ = track.centerline.to_frenet(line.x, line.y)
        for column, values in ((LINE_X, line.x), (LINE_Y, line.y), (LINE_SPEED, line.speed)):
            here[:, column] = np.interp(float(spacing) * np.arange(rows), at, values, period=track.centerline.length)
    return out


class ReferenceSpeeds:
    """The fastest speed of every car, by its own limits, all along the minimum-time line of the track that it is on.

    The line is that of the typical car: with a car's own line its lap would be faster by a few parts in a thousand.
    """

    def __init__(
        self, tracks: tuple[Track, ...], atlas: Atlas, limits: CarLimits, model: str, worlds: int, cars: int
    ) -> None:
        """Plan a line on each track, or take it from those that are kept.

        Args:
            tracks, atlas: see `racing_lines`.
            limits: of a typical car.
            model: of `SimulatorConfig`.
            worlds, cars: how many there are.

        Raises OutlapError for a track on which none can be planned.
        """
        self._model = model
        self._lines = [cached_line(track, limits).path.resampled(PROFILE_SPACING) for track in tracks]
        rows = atlas.index[:, ROWS]
        self._beside = [
            _points_beside(track, line, int(count))
            for track, line, count in zip(tracks, self._lines, rows, strict=True)
        ]
        self._first_row = atlas.index[:, FIRST_ROW]
        self._speed = np.zeros((worlds, cars, int(rows.max())), np.float32)

    def begin(self, which: np.ndarray, track: np.ndarray, params: np.ndarray) -> None:
        """Take note of worlds (n,) that begin an episode, on tracks (n,), with cars PARAMETERS (n, cars)."""
        cars = params.shape[1]
        limits = grip_and_motor(params, self._model)
        motors = np.stack([limits["a_max"], limits["a_brake"], params["v_max"], limits["v_switch"]], axis=-1)
        for number in map(int, np.unique(track)):
            here = np.flatnonzero(track == number)
            line, beside = self._lines[number], self._beside[number]
            mu = limits["mu"][here].reshape(-1, 1)
            speeds = speed_profiles(line.curvature, line.spacing, motors[here].reshape(-1, 4), mu)
            self._speed[which[here], :, : len(beside)] = speeds[:, beside].reshape(len(here), cars, -1)

    def at(self, car: int, track: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """The speeds [m/s] of a car of every world (worlds,) beside rows (worlds,) of the atlas."""
        return self._speed[np.arange(len(rows)), car, rows - self._first_row[track]]


def _points_beside(track: Track, line: ClosedPath, rows: int) -> np.ndarray:
    """The point of a line that lies beside each row of a centreline's table: (rows,)."""
    at, _ = track.centerline.to_frenet(*line.points.T)
    order = np.argsort(at, kind="stable")
    s = np.arange(rows) * (track.centerline.length / rows)
    after = np.searchsorted(at[order], s) % len(order)
    before = after - 1
    length = track.centerline.length
    gap_after, gap_before = (at[order[after]] - s) % length, (s - at[order[before]]) % length
    return order[np.where(gap_after < gap_before, after, before)]
