"""Environments: Gymnasium, Gymnasium's vector interface, Stable-Baselines3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from outlap.envs.race_config import RaceConfig
    from outlap.envs.race_env import RaceEnv
    from outlap.envs.race_vector_env import RaceVectorEnv
    from outlap.envs.sb3_vec_env import SB3VecEnv
    from outlap.envs.tasks import TaskSet, TaskSplit

__all__ = ["RaceConfig", "RaceEnv", "RaceVectorEnv", "SB3VecEnv", "TaskSet", "TaskSplit"]

_HOMES = {
    "RaceConfig": "race_config",
    "RaceEnv": "race_env",
    "RaceVectorEnv": "race_vector_env",
    "SB3VecEnv": "sb3_vec_env",
    "TaskSet": "tasks",
    "TaskSplit": "tasks",
}


def __getattr__(name: str) -> Any:  # imported when asked for: SB3 brings torch
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(f"outlap.envs.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
