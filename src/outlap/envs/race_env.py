"""RaceEnv: one race as a `gymnasium.Env`: the vector environment with one world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from outlap.drivers.driver import Driver
from outlap.envs.actions import check_actions
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.plugins import load
from outlap.track.track import Track

RENDER_MODES = ("human", "rgb_array")


class Renderer(Protocol):
    """Draws the first world of an environment; looked up as the entry point `live` of `outlap.renderers`."""

    def see(self, begins: bool) -> None:
        """Take note of a step, or of the beginning of an episode; show it if there is a window."""
        ...

    def pixels(self) -> np.ndarray | None:
        """Return the picture: uint8 (height, width, 3); None for a window, and before the first episode."""
        ...

    def close(self) -> None:
        """Close the window, if there is one."""
        ...


class RendererFactory(Protocol):
    """What the entry point holds."""

    def __call__(self, env: RaceVectorEnv, window: bool) -> Renderer: ...


class RaceEnv(gym.Env):
    """One race. Spaces and `info` are those of a world of `RaceVectorEnv`.

    `lap_time_s` and `last_lap_time_s` come into `info` with the first completed lap.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012  # as Gymnasium has it

    def __init__(
        self,
        config: RaceConfig,
        tracks: Sequence[Track] | None = None,
        opponents: Sequence[Driver] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Build a race. `envs.keywords.make_race` builds it from keywords.

        Args:
            config, tracks, opponents: see `RaceVectorEnv`.
            render_mode: "human" shows every step in a window, at the speed of the race; "rgb_array" makes `render`
                draw. Both need the extra `viewer`.

        Raises OutlapError as `RaceVectorEnv` does, and for another render mode.
        """
        if render_mode not in (None, *RENDER_MODES):
            raise OutlapError(f"render_mode is {render_mode!r}; must be None, {' or '.join(RENDER_MODES)}")
        self._env = RaceVectorEnv(1, config, tracks, opponents, autoreset_mode=AutoresetMode.DISABLED)
        self.config = config
        self.observation_space = self._env.single_observation_space
        self.action_space = self._env.single_action_space
        self.metadata = {**self.metadata, "render_fps": self._env.metadata["render_fps"]}
        self.render_mode = render_mode
        self._view: Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; a seed restarts the stream of episodes."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed)
        self._show(begins=True)
        return _only(observation), _only(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out an action (2,) in [-1, 1]: steering, speed. Raises OutlapError as `RaceVectorEnv` does."""
        action = check_actions(action, (2,), "step: given")
        observation, reward, terminated, truncated, info = self._env.step(action[None])
        self._show()
        return _only(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _only(info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The race from above: uint8 (720, 1280, 3) with render_mode "rgb_array"; a window shows itself."""
        return self._view.pixels() if self._view is not None else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def _show(self, begins: bool = False) -> None:
        if self.render_mode is None:
            return
        if self._view is None:
            renderer: RendererFactory = load("outlap.renderers", "live")
            self._view = renderer(self._env, window=self.render_mode == "human")
        self._view.see(begins)


def _only(batch: dict[str, Any]) -> dict[str, Any]:
    """The one world's values; masks, and what they say is not known, left out."""
    known = {name: value for name, value in batch.items() if not name.startswith("_") and batch.get(f"_{name}", [1])[0]}
    values = {name: value[0] for name, value in known.items()}
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
