"""Watch: a race in a window as it happens, with a person at the keyboard if one likes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from outlap.drivers.driver import Driver
from outlap.envs.actions import driver_actions
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.frame import Frame, between, cast_of, frame_of
from outlap.evaluation.protocol import single_race
from outlap.evaluation.recorder import how_it_ended
from outlap.track.track import Track
from outlap.viewer.scene import Entry, Trail, pygame
from outlap.viewer.window import FRAMES_PER_SECOND, LOOKING, Window, key_of

LONGEST_STEP = 0.1  # [s] that a picture may be late: a window that hangs does not race on
REST = 2.0  # [s] after an episode, before the next one
SLOWEST, FASTEST = 1 / 8, 8.0  # times real time
STEERING, STRAIGHTENING, ACCELERATING, BRAKING = 3.0, 5.0, 0.5, 1.2  # of a person's action, each second
KEYS = {
    **LOOKING,
    "space": "pause", ".": "a single step", "[ ]": "slower, faster", "n": "next episode",
    "k": "drive the followed car, or give it back", "arrows": "steer, accelerate and brake it", "h": "this help",
    "q, esc": "end",
}  # fmt: skip


class Watch:
    """Races of a driver on a track, one after another, in a window."""

    def __init__(
        self, driver: Driver, env: RaceConfig, track: Track, seed: int = 0, size: tuple[int, int] = (1280, 720)
    ) -> None:
        """Open the window and begin the first race.

        Args:
            driver: of the first car.
            env: the task, see `protocol.standing_starts`.
            track: to race on.
            seed: of the first episode; those after it go on from there.
            size: of the window (width, height) in pixels.

        Raises OutlapError where there is no screen, and what the environment raises.
        """
        self.env = single_race(driver, env, track)
        self.driver, self.track = driver, track
        self.window = Window(track, size)
        self.interval = env.control_interval * env.timestep  # [s] of an action
        self.paused, self.speed, self.help = False, 1.0, False
        self.episode = 0
        self._held: set[str] = set()  # keys
        self.driven: int | None = None  # car at the keyboard
        self._begin(seed)

    def run(self, on_picture: Callable[[Watch], None] | None = None) -> None:
        """Until the window is closed."""
        try:
            while self.window.open:
                self.update(min(self.window.wait(FRAMES_PER_SECOND), LONGEST_STEP))
                if on_picture is not None:
                    on_picture(self)
        finally:
            self.window.close()

    def update(self, seconds: float) -> None:
        """Let so much time go by, and draw."""
        for event in self.window.events():
            self._handle(event)
        if not self.window.open:
            return
        if not self.paused:
            if self.driven is not None:
                self._steer(seconds)
            self._advance(seconds * self.speed)
        shown = between(self._before, self._now, min(self._due / self.interval, 1.0))
        entry = Entry(self._cast, shown, self._trail.points)
        self.window.show([entry], self._note(), f"outlap: {self.driver.name} on {self.track.name}")

    def _begin(self, seed: int | None = None) -> None:
        self._observation, _ = self.env.reset(seed=seed)
        self.driver.begin(np.ones(1, bool))
        self._cast = cast_of(self.env, self.driver.name)
        self._before: Frame = frame_of(self.env)
        self._now = self._before
        self._trail = Trail()
        self._due = 0.0  # [s] since `_before` that have been shown
        self._rest = 0.0  # [s] until the next episode
        self._outcome = ""
        self.episode += 1
        self.drive(self.driven)

    def _advance(self, seconds: float) -> None:
        if self._outcome:
            self._rest -= seconds
            self._due = self.interval
            if self._rest <= 0.0:
                self._begin()
            return
        self._due += seconds
        while self._due >= self.interval and not self._outcome:
            self._due -= self.interval
            self._step()

    def _step(self) -> None:
        """An action of every car."""
        self._before = self._now
        if self._outcome:
            return
        self._trail.add(self._before)
        if self.driven is not None:
            self.env.taken_over = {self.driven: self._action.astype(np.float32)}
        self._observation, _, terminated, truncated, info = self.env.step(
            driver_actions(self.driver, self._observation, 1)
        )
        self._now = frame_of(self.env)
        if terminated[0] or truncated[0]:
            self._outcome, self._rest = how_it_ended(info), REST

    def drive(self, car: int | None) -> None:
        """Take a car over at the keyboard, at the speed that it has; None: give it back."""
        self.driven, self.env.taken_over = car, {}
        if car is not None:
            low, high = self.env.race.speeds[0, car]
            speed = float(self.env.race.speed[0, car])
            share = (speed - low) / (high - low) if high > low else 1.0
            self._action = np.array([0.0, np.clip(2.0 * share - 1.0, -1.0, 1.0)])

    def _steer(self, seconds: float) -> None:
        """Move the action as the arrow keys that are held say."""
        steer, speed = self._action
        wanted = ("left" in self._held) - ("right" in self._held)
        rate = STEERING if wanted else STRAIGHTENING
        steer += np.clip(wanted - steer, -rate * seconds, rate * seconds)
        speed += seconds * (ACCELERATING * ("up" in self._held) - BRAKING * ("down" in self._held))
        self._action = np.clip([steer, speed], -1.0, 1.0)

    def _handle(self, event: pygame.event.Event) -> None:
        if event.type == pygame.QUIT:
            self.window.close()
        elif event.type == pygame.KEYUP:
            self._held.discard(key_of(event))
        elif event.type == pygame.KEYDOWN:
            self._held.add(key_of(event))
            match key_of(event):
                case "escape" | "q":
                    self.window.close()
                case "space":
                    self.paused = not self.paused
                case ".":
                    self.paused, self._due = True, self.interval
                    self._step()
                case "[":
                    self.speed = max(0.5 * self.speed, SLOWEST)
                case "]":
                    self.speed = min(2.0 * self.speed, FASTEST)
                case "n":
                    self._begin()
                case "k":
                    followed = (self.window.following or EGO) % len(self._cast.drivers)
                    self.drive(None if self.driven is not None else followed)
                case "h":
                    self.help = not self.help

    def _note(self) -> str:
        if self.help:
            return "\n".join(f"{key}: {meaning}" for key, meaning in KEYS.items())
        parts = [f"episode {self.episode}", f"{self.speed:g} × real time"]
        if self.paused:
            parts.append("paused")
        if self.driven is not None:
            parts.append(f"you drive {self._cast.drivers[self.driven]}")
        if self._outcome:
            parts.append(self._outcome)
        return "   ".join([*parts, "h: help"])
