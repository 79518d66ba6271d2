"""Actions: (steer, speed) in [-1, 1], and the commands that they mean."""

from __future__ import annotations

import numpy as np

from outlap.simulator.vehicle import STEER_MAX, STEER_MIN, V_MAX, V_MIN


def speed_spans(params: np.ndarray, speed_range: tuple[float, float | None] | None) -> np.ndarray:
    """Speeds that the actions -1 and 1 command [m/s]: float32 (..., 2).

    Args:
        params: (..., N_PARAMS) of the cars.
        speed_range: the same for all; None: each car's v_min and v_max; (low, None): up to its v_max.
    """
    low, high = speed_range or (params[..., V_MIN], None)
    high = params[..., V_MAX] if high is None else high
    return np.stack(np.broadcast_arrays(low, high, params[..., 0])[:2], -1).astype(np.float32)


def commands(actions: np.ndarray, params: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Steering angles [rad] and speeds [m/s] of normalised actions.

    ±1 in the first column is the left / right stop, 0 is straight ahead; -1 … 1 in the second spans the car's speeds.

    Args:
        actions: (..., 2) in [-1, 1]: steer (left positive), speed.
        params: (..., N_PARAMS) of the cars.
        speeds: (..., 2) that -1 and 1 command [m/s].

    Returns:
        float32 (..., 2).
    """
    steer, speed = actions[..., 0], actions[..., 1]
    out = np.empty(actions.shape, np.float32)
    out[..., 0] = np.where(steer >= 0.0, steer * params[..., STEER_MAX], -steer * params[..., STEER_MIN])
    out[..., 1] = speeds[..., 0] + 0.5 * (speed + 1.0) * (speeds[..., 1] - speeds[..., 0])
    return out
