"""The scene shows walls, cars and beams where they are; environments render with it."""

from __future__ import annotations

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from imageio_ffmpeg import count_frames_and_secs

import outlap  # noqa: F401
from outlap.envs.keywords import make_race
from outlap.envs.race_env import RaceEnv
from outlap.errors import OutlapError
from outlap.evaluation.frame import Cast, Frame
from outlap.figure_style import BLUE, WALL_GREY
from outlap.simulator.collision import FREE, HIT_WALL, REMOVED
from outlap.track.track import Track
from outlap.viewer.scene import LONGEST_TRAIL, PAPER, RIVAL_GREY, Camera, Entry, Scene, Trail, bytes_of
from synthetic_tracks import ring


def entry(*places: tuple[float, float, float], scan: np.ndarray | None = None, contact: int = FREE) -> Entry:
    """Cars standing at x, y, yaw."""
    cars = len(places)
    motion = np.zeros((cars, 6))
    motion[:, :3] = places
    cast = Cast(
        drivers=tuple(f"car {car}" for car in range(cars)), sizes=((0.58, 0.31),) * cars, field_of_view=4.7,
        max_range=30.0, mount_x=0.0, mu=1.0,
    )  # fmt: skip
    contacts = np.full(cars, FREE)
    contacts[-1] = contact
    frame = Frame(
        0.0, motion, np.arange(cars, 0.0, -1.0), np.zeros(cars, int), np.full(cars, np.nan), contacts,
        np.zeros(0) if scan is None else scan,
    )  # fmt: skip
    return Entry(cast, frame)


def bare(track: Track) -> Scene:
    """A scene of walls and cars alone, in full view."""
    scene = Scene(track, (800, 600))
    scene.shown.lines = scene.shown.board = scene.shown.minimap = False
    return scene


def colour_at(scene: Scene, x: float, y: float) -> tuple[int, ...]:
    """What is shown at a place of the world [m]."""
    ((column, row),) = np.rint(scene._screen(scene._upright(np.array([[x, y]])))).astype(int)
    return tuple(scene.pixels()[row, column].tolist())


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize("zoom", [0.4, 1.0, 6.0])
def test_walls_are_where_the_track_has_them(yaw: float, zoom: float):
    track = ring(radius=8.0, half_width=1.2, yaw=yaw)
    scene = bare(track)
    scene.camera = Camera(scene.camera.x, scene.camera.y, zoom * scene.camera.scale)
    (middle,) = scene._upright(np.array([[8.0, 0.0]]))
    if zoom > 1.0:
        scene.camera = Camera(float(middle[0]), float(middle[1]), scene.camera.scale)
    scene.draw([])
    margin = 3.0 / scene.camera.scale  # three pixels
    for radius, colour in ((8.0, PAPER), (9.2 - margin, PAPER), (9.2 + margin, WALL_GREY), (6.8 - margin, WALL_GREY)):
        assert colour_at(scene, radius, 0.0) == bytes_of(colour), radius


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_cars_are_where_they_are_and_face_where_they_head(yaw: float):
    scene = bare(ring(yaw=yaw))
    scene.camera.scale = 200.0
    race = entry((8.0, 0.0, 0.5 * math.pi), (-8.0, 0.0, 0.0))
    scene.follow(race.frame, 0)
    scene.draw([race])
    assert colour_at(scene, 8.0, -0.2) == bytes_of(BLUE)  # the rear
    assert colour_at(scene, 8.0, 0.15) == bytes_of(PAPER)  # the nose's mark
    assert colour_at(scene, 8.25, 0.0) == bytes_of(PAPER)  # beside it
    scene.follow(race.frame, 1)
    scene.draw([race])
    assert colour_at(scene, -8.2, 0.0) == bytes_of(RIVAL_GREY)


def test_a_wreck_is_crossed_out_and_one_that_was_taken_away_is_not_shown():
    scene = bare(ring())
    scene.camera.scale = 200.0
    pictures = []
    for contact in (FREE, HIT_WALL, REMOVED):
        race = entry((8.0, 0.0, 0.0), (-8.0, 0.0, 0.0), contact=contact)
        scene.follow(race.frame, 1)
        scene.draw([race])
        pictures.append(scene.pixels().copy())
    reds = [((p[..., 0] == 0xC0) & (p[..., 1] == 0)).sum() for p in pictures]
    assert reds[1] > 100 > reds[0] == reds[2] == 0
    assert colour_at(scene, -8.2, 0.0) == bytes_of(PAPER)


def test_beams_end_on_the_walls():
    track = ring(radius=8.0, half_width=1.2)
    scene = bare(track)
    angles = np.linspace(-0.5, 0.5, 81) * 4.7 + 0.5 * math.pi
    # From (8, 0) to the outer wall, as if there was no inner one.
    along = np.cos(angles)
    reach = -8.0 * along + np.sqrt(64.0 * along**2 + 9.2**2 - 64.0)
    race = entry((8.0, 0.0, 0.5 * math.pi), scan=reach)
    scene.follow(race.frame, 0, 60.0)
    scene.draw([race])
    blue = (scene.pixels() == bytes_of(BLUE)).all(axis=2)
    rows, columns = np.nonzero(blue)
    x = scene.camera.x + (columns - 400.0) / 60.0 + track.origin[0]
    y = scene.camera.y - (rows - 300.0) / 60.0 + track.origin[1]
    outside = np.hypot(x - 8.0, y) > 0.5  # not the car
    assert outside.sum() > 60
    np.testing.assert_allclose(np.hypot(x, y)[outside], 9.2, atol=0.06)


def test_beams_that_hit_nothing_are_not_drawn():
    scene = bare(ring())
    race = entry((8.0, 0.0, 0.0), scan=np.full(81, 30.0))
    scene.follow(race.frame, 0, 60.0)
    scene.draw([race])
    with_scan = scene.pixels().copy()
    scene.shown.lidar = False
    scene.draw([race])
    np.testing.assert_array_equal(with_scan, scene.pixels())


def test_a_trail_keeps_the_newest_and_forgets_the_rest():
    trail = Trail()
    for i in range(3 * LONGEST_TRAIL):
        trail.add(entry((0.06 * i, 0.0, 0.0)).frame)  # every other one is too near to the one before
    points = trail.points
    assert len(points) <= LONGEST_TRAIL
    steps = np.diff(points[:, 0])
    np.testing.assert_allclose(steps, 0.12, atol=1e-9)
    assert points[-1, 0] == pytest.approx(0.06 * (3 * LONGEST_TRAIL - 2))


def test_zoom_has_its_bounds():
    scene = Scene(ring(), (320, 240))
    for factor, least, most in ((1e9, 100.0, 600.0), (1e-9, 0.0, scene.whole_track().scale)):
        scene.zoom(factor)
        assert least <= scene.camera.scale <= most
        scene.draw([])


def test_the_board_ranks_cars_by_distance():
    race = entry((8.0, 0.0, 0.0), (7.0, 0.0, 0.0), (6.0, 0.0, 0.0), contact=REMOVED)
    frame = race.frame
    assert frame.places.tolist() == [0, 1, 2]
    ahead = Frame(
        frame.time, frame.motion, np.array([1.0, 5.0, 9.0]), frame.laps, frame.lap_time, frame.contact, frame.scan
    )
    assert ahead.places.tolist() == [1, 0, 2]  # one that is off the track is last
    scene = Scene(ring(), (800, 600))
    scene.draw([race])
    first = scene.pixels().copy()
    scene.draw([Entry(race.cast, ahead)])
    assert (first != scene.pixels()).any()


def make(**settings) -> RaceEnv:
    return make_race(tracks=ring(), beams=40, render_mode="rgb_array", **settings)


def test_rgb_array_is_a_picture_that_changes_as_the_car_moves():
    env = make(num_cars=2)
    assert env.render() is None
    env.reset(seed=0)
    first = env.render()
    assert first is not None
    assert (first.shape, first.dtype) == ((720, 1280, 3), np.uint8)
    for _ in range(5):
        env.step(np.array([0.0, 0.5], np.float32))
    assert (env.render() != first).any()
    env.close()


def test_gymnasium_accepts_it_and_records_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    settings = {"tracks": ring(), "beams": 40, "control_interval": 4, "termination": {"time_limit": 0.4}}
    env = gym.make("outlap/Race-v0", render_mode="rgb_array", **settings)
    assert env.metadata["render_fps"] == 25
    check_env(env.unwrapped, skip_render_check=False, skip_close_check=True)
    recorded = RecordVideo(env, str(tmp_path), episode_trigger=lambda episode: True)
    recorded.reset(seed=1)
    steps, over = 0, False
    while not over:
        *_, terminated, truncated, _ = recorded.step(np.zeros(2, np.float32))
        steps, over = steps + 1, terminated or truncated
    recorded.close()
    (video,) = tmp_path.glob("*.mp4")
    frames, seconds = count_frames_and_secs(str(video))
    assert frames in (steps, steps + 1)  # moviepy may round the last one away
    assert seconds == pytest.approx(frames / 25, abs=0.05)


def test_another_render_mode_is_refused():
    with pytest.raises(OutlapError, match="render_mode is 'ansi'; must be None, human or rgb_array"):
        make_race(tracks=ring(), render_mode="ansi")
