"""Window: a scene on the screen, with its keys for looking; what the keys beyond those mean, others say."""

from __future__ import annotations

import os
from collections.abc import Sequence

from outlap.errors import OutlapError
from outlap.track.track import Track
from outlap.viewer.scene import Entry, Scene, pygame

FRAMES_PER_SECOND = 60
UNSEEN = ("dummy", "offscreen")  # SDL's drivers without a screen
ZOOM = 1.15  # a turn of the wheel, or a press of a key
LOOKING = {
    "tab": "follow the next car", "f": "whole track", "+ -": "zoom, as the wheel does", "drag": "move the picture",
    "l": "LiDAR", "r": "lines", "t": "trails", "b": "board",
}  # fmt: skip


class Window:
    """A live picture of races on a track."""

    def __init__(self, track: Track, size: tuple[int, int] = (1280, 720)) -> None:
        """Open it. Raises OutlapError where there is no screen."""
        try:
            pygame.display.init()
            # SDL falls back on a window that nobody sees.
            if pygame.display.get_driver() in UNSEEN and "SDL_VIDEODRIVER" not in os.environ:
                raise pygame.error("there is no screen")
            self.screen = pygame.display.set_mode(size, pygame.RESIZABLE)
        except pygame.error as error:
            pygame.display.quit()
            raise OutlapError(
                f"cannot open a window: {error}; without a screen, outlap video and outlap replay write files"
            ) from None
        self.scene = Scene(track, size)
        self.scene.camera.scale = self.scene.nearby()
        self.open = True
        self.following: int | None = 0  # car of the first race; None: the camera stays
        self._clock = pygame.time.Clock()
        self._title = ""

    def race_on(self, track: Track) -> None:
        """Show another track from now on."""
        if track is self.scene.track:
            return
        before, self.scene = self.scene, Scene(track, self.scene.size)
        self.scene.shown = before.shown
        if self.following is not None:
            self.scene.camera.scale = before.camera.scale

    def show(self, entries: Sequence[Entry], note: str = "", title: str = "outlap") -> None:
        """Draw races, and put the picture on the screen."""
        if not self.open:
            return
        if self.following is not None and entries:
            self.following %= len(entries[0].cast.drivers)
            self.scene.follow(entries[0].frame, self.following)
        self.scene.draw(entries, note)
        self.screen.blit(self.scene.surface, (0, 0))
        if title != self._title:
            pygame.display.set_caption(title)
            self._title = title
        pygame.display.flip()

    def wait(self, frames_per_second: float) -> float:
        """Wait for the next picture's moment; the seconds since the one before."""
        return self._clock.tick(frames_per_second) / 1000.0

    def events(self) -> list[pygame.event.Event]:
        """What happened at the window since last asked: those events that are not for looking."""
        if not self.open:
            return []
        return [event for event in pygame.event.get() if not self._handle(event)]

    def close(self) -> None:
        """Close it; `show` does nothing from then on."""
        if self.open:
            self.open = False
            pygame.display.quit()

    def _handle(self, event: pygame.event.Event) -> bool:
        """Whether an event was for looking, and is done with."""
        scene, shown = self.scene, self.scene.shown
        match event.type:
            case pygame.VIDEORESIZE:
                self.screen = pygame.display.get_surface() or self.screen
                scene.resize((event.w, event.h))
                if self.following is None:
                    scene.camera = scene.whole_track()
            case pygame.MOUSEWHEEL:
                scene.zoom(ZOOM**event.y)
            case pygame.MOUSEMOTION if event.buttons[0]:
                x, y = scene.metres(event.rel)
                scene.camera.x, scene.camera.y = scene.camera.x - x, scene.camera.y - y
                self.following = None
            case pygame.KEYDOWN:
                match key_of(event):
                    case "tab":
                        if self.following is None:
                            self.following, scene.camera.scale = 0, scene.nearby()
                        else:
                            self.following += 1  # `show` begins anew after the last one
                    case "f":
                        self.following, scene.camera = None, scene.whole_track()
                    case "+" | "=":
                        scene.zoom(ZOOM)
                    case "-":
                        scene.zoom(1.0 / ZOOM)
                    case "l":
                        shown.lidar = not shown.lidar
                    case "r":
                        shown.lines = not shown.lines
                    case "t":
                        shown.trails = not shown.trails
                    case "b":
                        shown.board = not shown.board
                    case _:
                        return False
            case _:
                return False
        return True


def key_of(event: pygame.event.Event) -> str:
    """The key of an event by what it types, whatever the keyboard's layout, or else by its name: "left", "tab"."""
    typed = getattr(event, "unicode", "")
    return typed.lower() if typed.isprintable() and typed.strip() else pygame.key.name(event.key)
