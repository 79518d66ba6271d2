"""The window without a screen: what its keys do, and that time goes by as it should."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from outlap.drivers.find import find_drivers
from outlap.envs.keywords import make_race
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.frame import Frame
from outlap.evaluation.protocol import standing_starts
from outlap.simulator.collision import HIT_WALL
from outlap.viewer.live import LiveView
from outlap.viewer.scene import Entry, pygame
from outlap.viewer.watch import REST, Watch
from synthetic_tracks import ring

TRACK = ring(radius=6.0, half_width=1.5)
PICTURE = 1 / 60  # [s]


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


@pytest.fixture
def watch() -> Watch:
    task = RaceConfig(num_cars=2, opponents=("pure-pursuit",), opponent_speed=2.0, beams=40, speed_range=(0.0, 4.0))
    (driver,) = find_drivers(["pure-pursuit"], task.field_of_view, split=None)
    return Watch(driver, standing_starts(task, [TRACK], laps=1, time_limit=20.0), TRACK, seed=1, size=(320, 240))


def press(watch: Watch, key: int, hold: int = 1) -> None:
    """Press a key for some pictures."""
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
    for _ in range(hold):
        watch.update(PICTURE)
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=key))
    watch.update(0.0)


def time_of(watch: Watch) -> float:
    return float(watch.env.race.worlds.time[0])


def test_a_second_is_a_second(watch: Watch):
    for _ in range(60):
        watch.update(PICTURE)
    assert time_of(watch) == pytest.approx(1.0, abs=watch.interval)
    press(watch, pygame.K_RIGHTBRACKET, hold=0)
    assert watch.speed == 2.0
    for _ in range(30):
        watch.update(PICTURE)
    assert time_of(watch) == pytest.approx(2.0, abs=2 * watch.interval)


def test_pause_and_single_steps(watch: Watch):
    watch.update(0.1)
    press(watch, pygame.K_SPACE)
    before = time_of(watch)
    for _ in range(30):
        watch.update(PICTURE)
    assert time_of(watch) == before
    press(watch, pygame.K_PERIOD)
    assert time_of(watch) == pytest.approx(before + watch.interval)
    press(watch, pygame.K_SPACE)
    watch.update(0.1)
    assert time_of(watch) > before + watch.interval


def test_the_next_episode_begins_by_key_and_by_itself(watch: Watch):
    watch.update(1.0)
    press(watch, pygame.K_n, hold=0)
    assert (watch.episode, time_of(watch)) == (2, 0.0)
    press(watch, pygame.K_k, hold=0)
    press(watch, pygame.K_UP, hold=400)  # straight on, into the wall
    assert watch.episode == 3


@pytest.mark.parametrize("car", [0, 1])
def test_a_person_drives_any_car_and_gives_it_back(watch: Watch, car: int):
    for _ in range(car):
        press(watch, pygame.K_TAB, hold=0)
    press(watch, pygame.K_k, hold=0)
    assert watch.driven == car
    press(watch, pygame.K_LEFT, hold=20)
    assert watch.env.race.actions[0, car, 0] > 0.5
    press(watch, pygame.K_RIGHT, hold=40)
    assert watch.env.race.actions[0, car, 0] < -0.5
    speed = watch.env.race.actions[0, car, 1]
    press(watch, pygame.K_UP, hold=20)
    assert watch.env.race.actions[0, car, 1] > speed
    press(watch, pygame.K_k, hold=0)
    assert watch.driven is None
    assert not watch.env.taken_over


def test_taking_over_keeps_the_speed(watch: Watch):
    watch.update(1.0)
    speed = float(watch.env.race.speed[0, 0])
    watch.drive(0)
    low, high = watch.env.race.speeds[0, 0]
    assert low + 0.5 * (watch._action[1] + 1.0) * (high - low) == pytest.approx(speed, abs=1e-6)


def test_a_crash_is_shown(watch: Watch, monkeypatch: pytest.MonkeyPatch):
    shown: list[Frame] = []
    show = watch.window.show

    def see(entries: Sequence[Entry], *words: str) -> None:
        shown.append(entries[0].frame)
        show(entries, *words)

    monkeypatch.setattr(watch.window, "show", see)
    press(watch, pygame.K_k, hold=0)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_UP))
    while watch.episode == 1:
        watch.update(PICTURE)
    crashed = [frame.contact[0] == HIT_WALL for frame in shown]
    assert sum(crashed) * PICTURE == pytest.approx(REST, abs=0.1)


def test_keys_for_looking(watch: Watch):
    scene = watch.window.scene
    for key, name in ((pygame.K_l, "lidar"), (pygame.K_r, "lines"), (pygame.K_t, "trails"), (pygame.K_b, "board")):
        press(watch, key)
        assert not getattr(scene.shown, name)
    scale = scene.camera.scale
    pygame.event.post(pygame.event.Event(pygame.MOUSEWHEEL, y=2))
    watch.update(0.0)
    assert scene.camera.scale > scale
    press(watch, pygame.K_f)
    assert watch.window.following is None
    whole = scene.camera.x
    pygame.event.post(pygame.event.Event(pygame.MOUSEMOTION, buttons=(1, 0, 0), rel=(30, 0)))
    watch.update(0.0)
    assert scene.camera.x == pytest.approx(whole - 30 / scene.camera.scale)
    press(watch, pygame.K_h)
    assert watch.help


def test_it_ends_when_the_window_is_closed(watch: Watch):
    pictures = 0

    def count(shown: Watch) -> None:
        nonlocal pictures
        pictures += 1
        if pictures == 5:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    watch.run(count)
    assert pictures == 6
    assert not watch.window.open


def test_render_mode_human_shows_every_step():
    env = make_race(tracks=TRACK, beams=0, observation=("vel",), render_mode="human")
    env.reset(seed=0)
    screen = pygame.display.get_surface()
    assert screen is not None
    first = pygame.image.tobytes(screen, "RGB")
    for _ in range(3):
        env.step(np.array([0.0, 0.5], np.float32))
    assert pygame.image.tobytes(screen, "RGB") != first
    env.close()
    assert not pygame.display.get_init()


def test_a_window_goes_on_with_the_next_track():
    env = make_race(tracks=[TRACK, ring(radius=5.0)], beams=0, observation=("vel",), render_mode="human")
    windows, tracks = set(), set()
    for seed in range(6):
        env.reset(seed=seed)
        assert isinstance(env._view, LiveView)
        window = env._view._window
        assert window is not None
        windows.add(id(window))
        tracks.add(window.scene.track.name)
    assert tracks == {"ring6", "ring5"}
    assert len(windows) == 1
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    env.step(np.zeros(2, np.float32))
    env.reset(seed=0)
    assert not pygame.display.get_init()  # closed by a person: it stays closed
    env.close()


def test_ctrl_c_stays_what_it_is(watch: Watch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            watch.run(lambda shown: os.kill(os.getpid(), signal.SIGINT) if time_of(shown) > 0.1 else None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not watch.window.open


def test_without_a_screen_it_says_what_else_there_is(monkeypatch: pytest.MonkeyPatch):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(OutlapError, match=r"cannot open a window.*outlap video and outlap replay write files"):
        make_race(tracks=TRACK, render_mode="human").reset(seed=0)
