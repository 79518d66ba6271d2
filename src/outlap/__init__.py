"""outlap: F1TENTH racing policies that adapt within an out-lap."""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from outlap.threads import wait_without_spinning

if TYPE_CHECKING:
    from outlap.errors import OutlapError
    from outlap.simulator.simulator import Simulator
    from outlap.track.catalog import load_track
    from outlap.track.track import Track

__all__ = ["OutlapError", "Simulator", "Track", "load_track"]
__version__ = version("outlap")

wait_without_spinning()  # before Numba and PyTorch load OpenMP

try:
    import gymnasium
except ModuleNotFoundError:  # on a car there are NumPy and onnxruntime, for `outlap.deploy`
    pass
else:
    if "outlap/Race-v0" not in gymnasium.registry:
        gymnasium.register(
            "outlap/Race-v0",
            entry_point="outlap.envs.race_env:RaceEnv",
            vector_entry_point="outlap.envs.race_vector_env:RaceVectorEnv",
        )

_HOMES = {
    "OutlapError": "outlap.errors",
    "Simulator": "outlap.simulator.simulator",
    "load_track": "outlap.track.catalog",
    "Track": "outlap.track.track",
}


def __getattr__(name: str) -> Any:  # imported when asked for, so that `outlap --help` answers at once
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
