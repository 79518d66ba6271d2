"""Scene: races on a track drawn from above, for the live window, for videos and for `render`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from outlap.envs.race import EGO
from outlap.errors import OutlapError
from outlap.evaluation.frame import SPEED, STEER, YAW, Cast, Frame, X, Y
from outlap.figure_style import COLOURS, INK, WALL_GREY
from outlap.simulator.collision import FREE, HIT_CAR, HIT_WALL, REMOVED
from outlap.track.track import Track

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")  # Ctrl-C and a kill stay what they are
try:
    import pygame
except ImportError as error:
    raise OutlapError("pygame-ce is not installed; pip install 'outlap[viewer]'") from error

PAPER, LINE_GREY, RIVAL_GREY, RACELINE = "#FFFFFF", "#A8A8A8", "#8A8A8A", "#CC79A7"
CRASH_RED = "#C00000"
SMALLEST_CAR = 11.0  # pixels that a car is long at least
NEARBY = 28.0  # [m] across the picture when a car is followed
BORDER = 1.5  # [m] around the track when all of it is shown
MINIMAP = 0.26  # of the picture's width and height, at most
LINE_SPACING = 0.25  # [m] between the points of the centreline
TRAIL_WIDTH = 2  # pixels
FARTHEST_OUT, NEAREST = 0.5, 500.0  # scales: times that of the whole track; pixels a metre
LONGEST_TRAIL, TRAIL_STEP = 4000, 0.1  # points, and [m] between them
STATES = {HIT_WALL: "hit a wall", HIT_CAR: "hit a car", REMOVED: "off the track"}


@dataclass(frozen=True)
class Entry:
    """A race in the picture. Several lie over one another, each in its colour."""

    cast: Cast
    frame: Frame
    trail: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) where the ego was before [m]
    title: str = ""


class Trail:
    """Where a car was: points some distance apart, the newest of them."""

    def __init__(self) -> None:
        self._points = np.zeros((LONGEST_TRAIL, 2))
        self._count = 0

    @property
    def points(self) -> np.ndarray:
        """(n, 2) [m], oldest first."""
        return self._points[: self._count]

    def add(self, frame: Frame) -> None:
        """Add where the ego is, unless it was there already."""
        point = frame.motion[EGO, [X, Y]]
        if self._count and np.hypot(*(point - self._points[self._count - 1])) < TRAIL_STEP:
            return
        if self._count == LONGEST_TRAIL:  # the older half is forgotten
            self._count //= 2
            self._points[: self._count] = self._points[-self._count :]
        self._points[self._count] = point
        self._count += 1


@dataclass
class Camera:
    """What of the track is shown."""

    x: float  # [m] of the middle, in the frame of the map's pixels, as all of this
    y: float
    scale: float  # pixels a metre


@dataclass
class Shown:
    """What is drawn beside walls and cars."""

    lidar: bool = True
    lines: bool = True
    trails: bool = True
    board: bool = True
    minimap: bool = True  # where only a part of the track is shown


class Scene:
    """Draws on its `surface`. Needs no display.

    The map's pixels stay upright: a map that is turned about its origin turns the picture, not the pixels.
    """

    def __init__(self, track: Track, size: tuple[int, int] = (1280, 720)) -> None:
        """A scene of a track in a picture of a size (width, height)."""
        pygame.font.init()
        self.track, self.shown = track, Shown()
        self._walls = _Walls(track)
        line = track.centerline
        points = line.position(np.arange(0.0, line.length, LINE_SPACING))
        self._centreline = self._upright(points)
        racing = track.raceline
        self._raceline = None if racing is None else self._upright(np.column_stack([racing.x, racing.y]))
        reach = BORDER + float(max(line.width_left.max(), line.width_right.max()))
        self._low, self._high = self._centreline.min(axis=0) - reach, self._centreline.max(axis=0) + reach
        self._fonts = {bold: pygame.font.Font(None, 22) for bold in (False, True)}
        self._fonts[True].set_bold(True)
        self.resize(size)
        self.camera = self.whole_track()

    def resize(self, size: tuple[int, int]) -> None:
        """Draw in another size (width, height) from now on."""
        self.surface = pygame.Surface(size, depth=32, masks=(0xFF0000, 0xFF00, 0xFF, 0))
        self._minimap: tuple[pygame.Surface, Camera] | None = None
        # Board and small map lie in the upper and the lower corners where the least of the track is.
        points = self._screen(self._centreline, self.whole_track()) / size
        left = [points[(points[:, 0] < 0.3) & half] for half in (points[:, 1] < 0.3, points[:, 1] > 0.7)]
        right = [points[(points[:, 0] > 0.7) & half] for half in (points[:, 1] < 0.3, points[:, 1] > 0.7)]
        self._on_the_right = [len(each) < len(other) for each, other in zip(right, left, strict=True)]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.surface.get_size()

    def whole_track(self) -> Camera:
        """A camera that shows all of the track."""
        span = self._high - self._low
        middle = 0.5 * (self._low + self._high)
        return Camera(float(middle[0]), float(middle[1]), float(min(np.array(self.size) / span)))

    def zoom(self, factor: float) -> None:
        """Come nearer, or go further away, as far as that makes sense."""
        least = FARTHEST_OUT * self.whole_track().scale
        self.camera.scale = min(max(factor * self.camera.scale, least), max(least, NEAREST))

    def follow(self, frame: Frame, car: int, scale: float | None = None) -> None:
        """Put a car in the middle; the scale stays, or is the one given."""
        x, y = self._place(frame, car)
        self.camera = Camera(float(x), float(y), scale or self.camera.scale)

    def nearby(self) -> float:
        """The scale at which what is near a car fills the picture."""
        return self.size[0] / NEARBY

    def draw(self, entries: Sequence[Entry], note: str = "") -> None:
        """Draw races at a moment, and a line of text below them."""
        self.surface.fill(PAPER)
        self._walls.draw(self.surface, self.camera)
        if self.shown.lines:
            self._polyline(self._centreline, LINE_GREY, closed=True)
            if self._raceline is not None:
                self._polyline(self._raceline, RACELINE, closed=True)
        coloured = list(zip(entries, COLOURS, strict=False))
        for entry, colour in coloured:
            if self.shown.trails:
                trail = np.vstack([entry.trail[-LONGEST_TRAIL:], entry.frame.motion[EGO, [X, Y]]])
                self._polyline(self._upright(trail), mixed_with_white(colour, 0.5), width=TRAIL_WIDTH)
            if self.shown.lidar:
                self._draw_scan(entry, colour)
        for entry, colour in coloured:
            for car in reversed(range(len(entry.cast.drivers))):  # the ego on top
                if entry.frame.contact[car] != REMOVED:
                    self._draw_car(entry, car, colour if car == EGO else RIVAL_GREY)
        if self.shown.minimap and self.camera.scale > 1.5 * self.whole_track().scale:
            self._draw_minimap(coloured)
        if self.shown.board and entries:
            self._draw_board(coloured)
        if note:
            text = self._fonts[False].render(note, True, INK)
            x = 10 if self._on_the_right[1] else self.size[0] - text.get_width() - 16
            self._panel(text, (x, self.size[1] - text.get_height() - 10))

    def pixels(self) -> np.ndarray:
        """The picture: uint8 (height, width, 3), red, green, blue."""
        width, height = self.size
        raw = np.frombuffer(self.buffer(), np.uint8).reshape(height, width, 4)
        return np.ascontiguousarray(raw[..., 2::-1])

    def buffer(self) -> bytes:
        """The picture as it lies in memory: rows of blue, green, red and a byte of nothing."""
        return self.surface.get_buffer().raw

    def metres(self, pixels: tuple[float, float]) -> tuple[float, float]:
        """Where a distance in pixels leads on the map [m]."""
        return pixels[0] / self.camera.scale, -pixels[1] / self.camera.scale

    def _upright(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 2) of the world in the frame of the map's pixels [m]."""
        x, y, yaw = self.track.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        moved = np.asarray(points, float) - (x, y)
        return np.column_stack([cos * moved[:, 0] + sin * moved[:, 1], cos * moved[:, 1] - sin * moved[:, 0]])

    def _place(self, frame: Frame, car: int) -> np.ndarray:
        """Return where a car is, (2,), in the frame of the map's pixels [m]."""
        return self._upright(frame.motion[[car]][:, [X, Y]])[0]

    def _screen(self, points: np.ndarray, camera: Camera | None = None, size: tuple[int, int] | None = None):
        """Return upright points (n, 2) in pixels of the picture."""
        camera = camera or self.camera
        return (points - (camera.x, camera.y)) * camera.scale * (1.0, -1.0) + 0.5 * np.array(size or self.size)

    def _polyline(
        self, points: np.ndarray, colour: str | tuple[int, ...], closed: bool = False, width: int = 1
    ) -> None:
        pixels = self._screen(np.vstack([points, points[:1]]) if closed else points)
        # Far beyond the edges nothing is drawn, and coordinates do not overflow.
        near = np.all(np.abs(pixels - 0.5 * np.array(self.size)) < 2 * np.array(self.size), axis=1)
        ends = np.flatnonzero(np.diff(near)) + 1
        for piece, inside in zip(np.split(pixels, ends), near[[0, *ends]], strict=True):
            if inside and len(piece) > 1:
                if width == 1:
                    pygame.draw.aalines(self.surface, colour, False, piece.tolist())
                else:
                    pygame.draw.lines(self.surface, colour, False, piece.tolist(), width)

    def _draw_scan(self, entry: Entry, colour: str) -> None:
        places = np.rint(self._screen(self._upright(entry.cast.beam_ends(entry.frame)))).astype(int)
        places = places[((places >= 0) & (places < np.array(self.size) - 1)).all(axis=1)]
        pixels = pygame.surfarray.pixels3d(self.surface)
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            pixels[places[:, 0] + x, places[:, 1] + y] = bytes_of(colour)

    def _draw_car(self, entry: Entry, car: int, colour: str) -> None:
        length, width = entry.cast.sizes[car]
        yaw, steer = entry.frame.motion[car, [YAW, STEER]]
        grow = max(1.0, SMALLEST_CAR / (length * self.camera.scale))
        (middle,) = self._screen(self._place(entry.frame, car)[None])
        yaw = yaw - self.track.origin[2]

        def polygon(corners: np.ndarray, fill: str, at: tuple[float, float] = (0.0, 0.0), turn: float = 0.0) -> None:
            corners = corners @ _rotation(turn).T + at
            pixels = (corners * grow @ _rotation(yaw).T) * self.camera.scale * (1.0, -1.0) + middle
            pygame.draw.polygon(self.surface, fill, pixels.tolist())
            pygame.draw.aalines(self.surface, INK, True, pixels.tolist())

        wheel = _box(0.18 * length, 0.30 * width)
        for along, side, turn in ((0.3, 0.5, steer), (0.3, -0.5, steer), (-0.3, 0.5, 0.0), (-0.3, -0.5, 0.0)):
            polygon(wheel, INK, (along * length, side * width), float(turn))
        polygon(_box(length, 0.8 * width), colour)
        nose = np.array([[0.44 * length, 0.0], [0.16 * length, 0.26 * width], [0.16 * length, -0.26 * width]])
        polygon(nose, PAPER)
        if entry.frame.contact[car] != FREE:
            reach = 0.7 * max(length * self.camera.scale, SMALLEST_CAR)
            for sign in (1.0, -1.0):
                ends = middle + np.array([[-reach, -sign * reach], [reach, sign * reach]])
                pygame.draw.line(self.surface, CRASH_RED, ends[0].tolist(), ends[1].tolist(), 3)

    def _draw_minimap(self, coloured: Sequence[tuple[Entry, str]]) -> None:
        if self._minimap is None:
            span = self._high - self._low
            scale = float(min(MINIMAP * np.array(self.size) / span))
            surface = pygame.Surface(np.ceil(span * scale).astype(int).tolist())
            surface.fill(PAPER)
            whole = self.whole_track()
            camera = Camera(whole.x, whole.y, scale)
            points = self._screen(self._centreline, camera, surface.get_size())
            pygame.draw.lines(surface, LINE_GREY, True, points.tolist(), 3)
            pygame.draw.rect(surface, LINE_GREY, surface.get_rect(), 1)
            self._minimap = surface, camera
        surface, camera = self._minimap
        corner = np.array(self.size) - surface.get_size() - (10, 10)
        if not self._on_the_right[1]:
            corner[0] = 10
        self.surface.blit(surface, corner.tolist())
        for entry, colour in coloured:
            for car in reversed(range(len(entry.cast.drivers))):
                if entry.frame.contact[car] != REMOVED:
                    (place,) = self._screen(self._place(entry.frame, car)[None], camera, surface.get_size())
                    fill = colour if car == EGO else RIVAL_GREY
                    pygame.draw.aacircle(self.surface, fill, (place + corner).tolist(), 4)

    def _draw_board(self, coloured: Sequence[tuple[Entry, str]]) -> None:
        """Time, and of every car its place, speed, laps and last lap."""
        time = max(entry.frame.time for entry, _ in coloured)
        rows: list[tuple[str, ...]] = [(f"{time:.1f} s", "", "m/s", "lap", "last")]
        colours = [INK]
        for entry, colour in coloured:
            frame, alone = entry.frame, len(coloured) == 1
            for place, car in enumerate(frame.places.tolist() if alone else [EGO], start=1):
                name = entry.cast.drivers[car] if alone else entry.title or entry.cast.drivers[car]
                last = "" if np.isnan(frame.lap_time[car]) else f"{frame.lap_time[car]:.2f}"
                state = STATES.get(int(frame.contact[car]), f"{frame.motion[car, SPEED]:.1f}")
                rows.append((str(place) if alone else "", name[:28], state, str(int(frame.laps[car]) + 1), last))
                colours.append(colour if car == EGO else INK)
        texts = [
            [self._fonts[row is rows[0] or colour != INK].render(cell, True, colour) for cell in row]
            for row, colour in zip(rows, colours, strict=True)
        ]
        widths = [max(row[column].get_width() for row in texts) for column in range(len(rows[0]))]
        height = texts[0][0].get_height() + 3
        panel = pygame.Surface((sum(widths) + 10 * (len(widths) - 1), height * len(rows)), pygame.SRCALPHA)
        for number, row in enumerate(texts):
            x = 0
            for column, (text, width) in enumerate(zip(row, widths, strict=True)):
                # Words to the left, numbers to the right.
                panel.blit(text, (x if column in (0, 1) else x + width - text.get_width(), number * height))
                x += width + 10
        self._panel(panel, (self.size[0] - panel.get_width() - 16 if self._on_the_right[0] else 10, 10))

    def _panel(self, content: pygame.Surface, corner: tuple[int, int]) -> None:
        """A surface on a pale ground, legible on walls too."""
        width, height = content.get_size()
        ground = pygame.Surface((width + 14, height + 10), pygame.SRCALPHA)
        ground.fill((255, 255, 255, 215))
        ground.blit(content, (7, 5))
        self.surface.blit(ground, (corner[0] - 4, corner[1] - 4))


class _Walls:
    """The map in halved sizes: one for every scale, in each of which a pixel with any wall in it is wall."""

    def __init__(self, track: Track) -> None:
        self.resolution = track.resolution
        self.levels: list[tuple[pygame.Surface, float]] = []  # pictures, and their height [m]
        block = 1
        while True:
            walls = track.coarse(block)
            pixels = np.empty((*walls.shape[::-1], 3), np.uint8)
            pixels[:] = bytes_of(PAPER)
            pixels[walls[::-1].T] = bytes_of(WALL_GREY)  # a picture begins at the top
            surface = pygame.Surface(walls.shape[::-1])
            pygame.surfarray.blit_array(surface, pixels)
            self.levels.append((surface, len(walls) * block * track.resolution))
            if min(walls.shape) < 64:
                break
            block *= 2

    def draw(self, surface: pygame.Surface, camera: Camera) -> None:
        """The part of the map that a camera shows."""
        width, height = surface.get_size()
        # The coarsest level whose pixels are no larger than two of the picture's.
        level = math.ceil(math.log2(max(1.0 / (self.resolution * camera.scale), 1.0)))
        level = min(level, len(self.levels) - 1)
        source, tall = self.levels[level]
        metres = self.resolution * 2**level
        left, top = camera.x - 0.5 * width / camera.scale, camera.y + 0.5 * height / camera.scale
        first = np.floor(np.array([left, tall - top]) / metres).astype(int)
        count = np.ceil(np.array([width, height]) / camera.scale / metres).astype(int) + 2
        low, high = np.maximum(first, 0), np.minimum(first + count, source.get_size())
        if (high <= low).any():
            return
        part = source.subsurface((*low.tolist(), *(high - low).tolist()))
        corner = (low * metres - (left, tall - top)) * camera.scale
        size = np.rint((high - low) * metres * camera.scale).astype(int)
        surface.blit(pygame.transform.scale(part, size.tolist()), np.rint(corner).astype(int).tolist())


def bytes_of(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of "#RRGGBB"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def mixed_with_white(colour: str, share: float) -> tuple[int, ...]:
    """A colour with a share of white."""
    return tuple(round(value + (255 - value) * share) for value in bytes_of(colour))


def _rotation(angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _box(length: float, width: float) -> np.ndarray:
    """Corners (4, 2) of a rectangle about the origin."""
    return 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
