"""CarDriver: drives a car with an exported policy. Needs NumPy and onnxruntime, and nothing else of outlap."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from outlap.errors import OutlapError, brief

METADATA = "outlap"  # key of what an exported file says about itself
FORMAT = 1
COMMAND, ACTION, STATE, NEXT_STATE = "command", "action", "state", "next_state"
SLOWEST_WITH_SLIP = 0.1  # [m/s]: below it the slip angle is taken as 0
FARTHEST_NEIGHBOUR = math.radians(3.0)  # from which a return that is missing is filled in
AHEAD = math.radians(30.0)  # to either side: nobody drives where nothing is known, however much is known beside
TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Command:
    """What the car is to do."""

    steering_angle: float  # [rad], left positive
    speed: float  # [m/s]
    reason: str = ""  # why the car is stopped; empty while it is driven


@dataclass(frozen=True)
class Limits:
    """What input is believed."""

    stale_after: float = 0.2  # [s] age of a scan or of odometry
    fastest: float = 1.5  # times the policy's top speed
    spinning: float = 15.0  # [rad/s] yaw rate
    sharpest: float = 1.5  # times the policy's largest steering angle
    least_returns: float = 0.5  # share of beams, and of those ahead, that must be known
    shortest: float = 0.02  # [m]: a range below it is no return


class CarDriver:
    """An exported policy on a car.

    Call `drive` every `interval` seconds with the newest scan and odometry; it never raises for what sensors say, but
    stops the car and says why.
    """

    def __init__(self, path: str | os.PathLike[str], limits: Limits | None = None) -> None:
        """Load a file that `outlap export` wrote. It holds numbers and products of them, and no code.

        Raises OutlapError for a file that is missing, broken, or no exported policy.
        """
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        if not Path(path).is_file():
            raise OutlapError(f"{path}: no such file; make one with outlap export RUN")
        try:
            self._session = onnxruntime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
            text = self._session.get_modelmeta().custom_metadata_map[METADATA]
            facts: dict[str, Any] = json.loads(text)
            if facts["format"] != FORMAT:
                raise ValueError(f"its format is {facts['format']}, and {FORMAT} is known here")
            self.terms: tuple[str, ...] = tuple(facts["terms"])
            self.beams, self.field_of_view = int(facts["beams"]), float(facts["field_of_view"])
            self.max_range, self.interval = float(facts["max_range"]), float(facts["interval_s"])
            self.speeds: tuple[float, float] = tuple(map(float, facts["speeds"]))  # type: ignore[assignment]
            self.steering: tuple[float, float] = tuple(map(float, facts["steering"]))  # type: ignore[assignment]
            self.reward: dict[str, float] = {name: float(weight) for name, weight in facts["reward"].items()}
        except Exception as error:  # whatever a broken file raises
            raise OutlapError(f"{path}: is no policy of outlap export: {brief(error)}") from None
        self.limits = limits or Limits()
        self._angles = np.linspace(-0.5, 0.5, self.beams) * self.field_of_view
        self._ahead = np.abs(self._angles) <= AHEAD
        (size,) = next(each.shape for each in self._session.get_inputs() if each.name == STATE)
        self._state = np.zeros(size, np.float32)
        self.begin()

    def begin(self) -> None:
        """Forget what was before: the car is put somewhere, or was stopped."""
        self._state[:] = 0.0
        self._actions = np.zeros((2, 2), np.float32)  # the one before last, and the last one
        self._command = Command(0.0, 0.0)

    def drive(
        self,
        ranges: np.ndarray,
        angle_min: float,
        angle_increment: float,
        velocity: tuple[float, float, float],
        *,
        scan_age: float = 0.0,
        odometry_age: float = 0.0,
        steering_angle: float | None = None,
    ) -> Command:
        """What to do now.

        Args:
            ranges: (n,) of a LaserScan [m]; inf: nothing there; NaN, 0 and less: not known.
            angle_min: of the first one [rad], 0 is ahead, left positive.
            angle_increment: from each to the next [rad].
            velocity: of the centre of gravity, forward and to the left [m/s], and yaw rate [rad/s].
            scan_age, odometry_age: how old they are [s].
            steering_angle: as measured [rad]; by default that of the last command.
        """
        ranges = np.asarray(ranges, np.float32).ravel()
        scan, unknown = self.resample(ranges, angle_min, angle_increment)
        reason = self._mistrust(velocity, scan_age, odometry_age, steering_angle)
        if self.beams:
            reason = reason or _misplaced(len(ranges), angle_min, angle_increment) or self._mistrust_scan(scan, unknown)
        if reason:
            return self._stop(reason)
        forward, left, yaw_rate = map(float, velocity)
        steering = self._command.steering_angle if steering_angle is None else float(steering_angle)
        slip = math.atan(left / forward) if abs(forward) > SLOWEST_WITH_SLIP else 0.0
        known = {
            "scan": scan,
            "vel": [forward, left, yaw_rate],
            "heading": [steering, slip],
            "previous_reward": [self._estimated_reward(forward)],
            "action_span": [self.steering[1], *self.speeds],
        }
        command = self.act({name: np.asarray(known[name], np.float32) for name in self.terms})
        if not all(np.isfinite(each).all() for each in (command, self.action, self._state)):
            return self._stop("policy: its command or its memory is not finite")
        self._command = Command(float(command[0]), float(command[1]))
        return self._command

    def _stop(self, reason: str) -> Command:
        steering = self._command.steering_angle
        self.begin()  # what follows is another stretch: nothing is known of what happens meanwhile
        self._command = Command(steering, 0.0, reason)
        return self._command

    @property
    def action(self) -> np.ndarray:
        """The last action, in [-1, 1]: (2,) steer, speed."""
        return self._actions[1]

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Steering angle [rad] and speed [m/s] from observation terms in their units, in place of `drive`: (2,)."""
        given = {**observation, STATE: self._state}
        command, action, state = map(np.asarray, self._session.run([COMMAND, ACTION, NEXT_STATE], given))
        self._actions, self._state = np.stack([self._actions[1], action]), state
        return command

    def resample(self, ranges: np.ndarray, angle_min: float, angle_increment: float) -> tuple[np.ndarray, np.ndarray]:
        """A scan as the policy's own scanner would have it, (beams,) [m], and which beams are not known, (beams,) bool.

        Every beam takes the return nearest in angle, and is not known where that is more than 3 degrees away. Far and
        infinite ranges become the largest that was trained.
        """
        ranges = np.asarray(ranges, np.float32).ravel()
        nothing = np.zeros(self.beams, np.float32), np.ones(self.beams, bool)
        placed = math.isfinite(angle_min) and math.isfinite(angle_increment) and angle_increment
        if not placed or _misplaced(len(ranges), angle_min, angle_increment):
            return nothing
        usable = ~(np.isnan(ranges) | (ranges < self.limits.shortest))
        angles = angle_min + angle_increment * np.arange(len(ranges))
        angles = np.angle(np.exp(1j * angles))  # in (-π, π]
        order = np.argsort(angles)
        order = order[usable[order]]
        if not len(order):
            return nothing
        known = angles[order]
        at = np.searchsorted(known, self._angles)
        left, right = np.maximum(at - 1, 0), np.minimum(at, len(known) - 1)
        nearest = np.where(self._angles - known[left] <= known[right] - self._angles, left, right)
        away = np.abs(known[nearest] - self._angles)
        scan = np.clip(ranges[order][nearest], 0.0, self.max_range)  # inf becomes the largest
        return scan.astype(np.float32), away > FARTHEST_NEIGHBOUR

    def _mistrust_scan(self, scan: np.ndarray, unknown: np.ndarray) -> str:
        """Why a resampled scan, (beams,), is not believed; empty where it is."""
        for where, beams in (("", unknown), (" ahead", unknown[self._ahead])):
            missing = np.count_nonzero(beams)
            if not missing <= (1.0 - self.limits.least_returns) * len(beams):
                return f"scan: {missing / len(beams):.0%} of the policy's {len(beams)} beams{where} are not known"
        if not scan.min() < self.max_range:  # millimetres, or a scanner that says inf for what it could not measure
            return f"scan: nothing within {self.max_range:g} m in any direction"
        return ""

    def _mistrust(
        self, velocity: tuple[float, float, float], scan_age: float, odometry_age: float, steering_angle: float | None
    ) -> str:
        """Why odometry, ages and the steering angle are not believed; empty where they are."""
        limits = self.limits
        for name, age in (("scan", scan_age), ("odometry", odometry_age)):
            if not -limits.stale_after <= age <= limits.stale_after:  # NaN is not either
                return f"{name} is {age:.2f} s old; must be {limits.stale_after:g} s or less"
        if len(velocity) != 3 or not np.isfinite(velocity).all():
            return f"odometry is {tuple(velocity)}; must be three finite numbers"
        fastest = limits.fastest * max(map(abs, self.speeds))
        if not math.hypot(velocity[0], velocity[1]) <= fastest:
            return f"odometry: {math.hypot(velocity[0], velocity[1]):.1f} m/s; at most {fastest:.1f} is believed"
        if not abs(velocity[2]) <= limits.spinning:
            return f"odometry: turns at {velocity[2]:.1f} rad/s; at most {limits.spinning:g} is believed"
        sharpest = limits.sharpest * max(map(abs, self.steering))
        if steering_angle is not None and not abs(steering_angle) <= sharpest:
            return f"steering angle is {steering_angle:.4g} rad; at most {sharpest:.2g} is believed"
        return ""

    def _estimated_reward(self, forward: float) -> float:
        """What training would have paid for the last action, as far as a car can tell: advance, and a smooth hand."""
        if not self._actions.any():  # at the begin of a stretch
            return 0.0
        change = np.abs(self._actions[1] - self._actions[0])
        weights = self.reward
        return (
            weights.get("progress", 0.0) * forward * self.interval
            - weights.get("steering_change", 0.0) * float(change[0])
            - weights.get("speed_change", 0.0) * float(change[1])
        )


def _misplaced(count: int, angle_min: float, angle_increment: float) -> str:
    """Why the angles of `count` ranges [rad] are not believed; empty where they lie within a turn."""
    most = TURN + abs(angle_increment)  # some scanners give the first return once more at the end
    span = max(count - 1, 0) * abs(angle_increment)
    for what, angle in (("begins at", angle_min), ("spans", span)):
        if abs(angle) > most:
            return f"scan {what} {angle:.4g} rad, more than a turn; are its angles in degrees?"
    return ""
