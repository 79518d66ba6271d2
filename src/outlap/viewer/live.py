"""LiveView: what `render` of an environment shows."""

from __future__ import annotations

import numpy as np

from outlap.envs.race import EGO
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.evaluation.frame import Frame, cast_of, frame_of
from outlap.track.track import Track
from outlap.viewer.scene import Entry, Scene, Trail, pygame
from outlap.viewer.window import FRAMES_PER_SECOND, Window


class LiveView:
    """The first world of an environment: in a window, or as pixels."""

    def __init__(self, env: RaceVectorEnv, window: bool) -> None:
        self._env, self._in_window = env, window
        self._window: Window | None = None
        self._scenes: dict[int, Scene] = {}  # by the track's number
        self._frame: Frame | None = None
        self._trail = Trail()
        self._shown = 0.0  # [s] of the race when the window was last drawn

    def see(self, begins: bool) -> None:
        """Take note of a step, or of an episode's begin; show it where there is a window."""
        if begins:
            self._trail = Trail()
            self._cast = cast_of(self._env, "ego")
        elif self._frame is not None:
            self._trail.add(self._frame)
        self._frame = frame_of(self._env)
        if self._in_window:
            self._show(self._frame, begins)

    def pixels(self) -> np.ndarray | None:
        """The picture: uint8 (height, width, 3); None for a window, and before the first episode."""
        if self._in_window or self._frame is None:
            return None
        number = int(self._env.race.worlds.track[0])
        if number not in self._scenes:
            self._scenes[number] = Scene(self._track)
        scene = self._scenes[number]
        scene.follow(self._frame, EGO, scene.nearby())
        scene.draw([Entry(self._cast, self._frame, self._trail.points)])
        return scene.pixels()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    @property
    def _track(self) -> Track:
        return self._env.tasks.tracks[int(self._env.race.worlds.track[0])]

    def _show(self, frame: Frame, begins: bool) -> None:
        if self._window is None:
            self._window = Window(self._track)
        window = self._window
        if not window.open:  # a person has closed it
            return
        if any(event.type == pygame.QUIT for event in window.events()):
            window.close()
        if begins:
            window.race_on(self._track)
        if begins or frame.time >= self._shown + 1.0 / FRAMES_PER_SECOND:
            self._shown = frame.time
            window.show([Entry(self._cast, frame, self._trail.points)])
        window.wait(self._env.metadata["render_fps"])
