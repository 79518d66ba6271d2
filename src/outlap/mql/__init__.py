"""Meta-Q-Learning with adaptive β clipping, on Stable-Baselines3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from outlap.mql.adaptation import AdaptationSettings, adapt
    from outlap.mql.context_vec_env import ContextVecEnv
    from outlap.mql.mql import MQL
    from outlap.mql.propensity import AdaptiveBetaClip, FixedClip, NoClip

__all__ = ["MQL", "AdaptationSettings", "AdaptiveBetaClip", "ContextVecEnv", "FixedClip", "NoClip", "adapt"]

_HOMES = {
    "MQL": "mql",
    "AdaptationSettings": "adaptation",
    "AdaptiveBetaClip": "propensity",
    "ContextVecEnv": "context_vec_env",
    "FixedClip": "propensity",
    "NoClip": "propensity",
    "adapt": "adaptation",
}


def __getattr__(name: str) -> Any:  # imported when asked for: SB3 brings torch
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(f"outlap.mql.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
