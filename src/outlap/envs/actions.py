"""Actions: (steer, speed) in [-1, 1]; their validation and their conversion to commands."""

from __future__ import annotations

from typing import Any

import numpy as np

from outlap.drivers.driver import Driver
from outlap.errors import OutlapError


def speed_spans(params: np.ndarray, speed_range: tuple[float, float | None] | None) -> np.ndarray:
    """Speeds that the actions -1 and 1 command [m/s]: float32 (..., 2).

    Args:
        params: PARAMETERS (...) of the cars.
        speed_range: the same for all; None: each car's v_min and v_max; (low, None): up to its v_max.
    """
    low, high = speed_range or (params["v_min"], None)
    high = params["v_max"] if high is None else high
    return np.stack(np.broadcast_arrays(low, high, params["v_max"])[:2], -1).astype(np.float32)


def commands(actions: np.ndarray, params: np.ndarray, speeds: np.ndarray, command: str = "speed") -> np.ndarray:
    """Return the commands of normalised actions: steering angles [rad] and speeds [m/s] or shares of the largest force.

    ±1 in the first column is the left / right stop, 0 is straight ahead; -1 … 1 in the second spans the car's speeds,
    or full braking to full drive where `command` is `acceleration`.

    Args:
        actions: (..., 2) in [-1, 1]: steer (left positive), speed.
        params: PARAMETERS (...) of the cars.
        speeds: (..., 2) that -1 and 1 command [m/s].
        command: see `SimulatorConfig.command`.

    Returns:
        float32 (..., 2).
    """
    steer, speed = actions[..., 0], actions[..., 1]
    out = np.empty(actions.shape, np.float32)
    out[..., 0] = np.where(steer >= 0.0, steer * params["steer_max"], -steer * params["steer_min"])
    if command == "acceleration":
        out[..., 1] = speed
        return out
    out[..., 1] = speeds[..., 0] + 0.5 * (speed + 1.0) * (speeds[..., 1] - speeds[..., 0])
    return out


def check_actions(answer: Any, shape: tuple[int, ...], who: str) -> np.ndarray:
    """Validate actions from outside and clip them to [-1, 1]: float32.

    Args:
        answer: the actions, as given.
        shape: the shape that they must have, (..., 2).
        who: where they come from; an error message begins with it.

    Raises OutlapError for values that are not numbers, for another shape, and for NaN and infinity.
    """
    try:
        actions = np.asarray(answer)
    except ValueError:  # rows of unequal lengths
        actions = np.array(None)
    if actions.dtype.kind not in "fiub":
        raise OutlapError(f"{who} {answer!r:.60}; must be numbers {shape}")
    if actions.shape != shape:
        raise OutlapError(f"{who} actions of shape {actions.shape}; must be {shape}")
    finite = np.isfinite(actions).all(axis=-1)
    if not finite.all():
        row = int(np.argmin(finite))
        where = f" (row {row})" if len(shape) > 1 else ""
        raise OutlapError(f"{who} the action {np.atleast_2d(actions)[row].tolist()}; must be finite{where}")
    return np.clip(actions, -1.0, 1.0).astype(np.float32, copy=False)


def driver_actions(driver: Driver, observation: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Return a driver's actions for `count` cars: float32 (count, 2) in [-1, 1].

    Raises OutlapError that names the driver if its actions are not numbers, not finite, or of a wrong shape.
    """
    return check_actions(driver.act(observation), (count, 2), f"driver {driver.name}: gave")
