"""Ghosts: a recorded lap is followed, at its speeds; it is recorded from a driver, written, read, and refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from outlap.drivers.classical import PurePursuit
from outlap.drivers.driver import FunctionDriver
from outlap.drivers.ghost import COLUMNS, PREVIEW, Ghost
from outlap.envs.keywords import make_race_vector
from outlap.envs.observations import observe
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.recorder import record_lap
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import VehicleParams
from outlap.track.centerline import Centerline
from outlap.track.track import Track
from outlap.track.walls import draw_walls
from synthetic_tracks import ring

RADIUS, LINE = 5.0, 5.4  # [m] of the ring, and of the lap on it
TASK = RaceConfig(beams=0, control_interval=4, vehicle=VehicleParams(v_max=6.0), speed_range=(0.0, 6.0))
ACTION = 0.04  # [s]


def recorded_speed(angle: np.ndarray) -> np.ndarray:
    """Fast on one side of the ring, slow on the other: [m/s]."""
    return 2.5 + np.sin(angle)


def circle_lap(points: int = 200) -> np.ndarray:
    """A lap of the ring, outside of its centreline."""
    angle = np.linspace(0.0, 2.0 * math.pi, points, endpoint=False)
    speed = recorded_speed(angle)
    t = np.cumsum(np.full(points, 2.0 * math.pi * LINE / points) / speed)
    return np.stack([t, LINE * np.cos(angle), LINE * np.sin(angle), angle + 0.5 * math.pi, speed], axis=1)


def driven(ghost: Ghost, seconds: float, **start) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radius [m], angle about the ring's middle and speed [m/s] of a ghost's cars, before every step: (steps, 8)."""
    changes = {"observation": ghost.observation_terms, "start": StartConfig.model_validate(start)}
    env = RaceVectorEnv(8, TASK.model_copy(update=changes), [ring(RADIUS)])
    observation, _ = env.reset(seed=0)
    seen = []
    for _ in range(round(seconds / ACTION)):
        x, y, _ = observation["pose"].T
        seen.append([np.hypot(x, y), np.arctan2(y, x), observation["vel"][:, 0]])
        observation, _, terminated, _, _ = env.step(ghost.act(observation))
        assert not terminated.any()
    radius, angle, speed = np.moveaxis(np.array(seen), 1, 0)
    return radius, angle, speed


def test_a_lap_is_driven_again_in_the_time_it_took() -> None:
    track, lap = ring(RADIUS), circle_lap()
    rows = evaluate(Ghost(lap), standing_starts(TASK, [track], laps=2), [track], episodes=4, seed=0)
    assert rows["outcome"].tolist() == ["finished"] * 4
    np.testing.assert_allclose(rows["lap_time_s"], lap[-1, 0], rtol=0.02)


def test_it_has_the_recorded_speed_in_every_place() -> None:
    _, angle, speed = driven(Ghost(circle_lap()), 12.0, speed=2.5)
    steady = slice(50, None)
    np.testing.assert_allclose(speed[steady], recorded_speed(angle[steady]), atol=0.15)
    assert np.ptp(speed[steady]) > 1.8  # both sides of the ring were driven


def test_beside_its_line_it_comes_back_to_it() -> None:
    radius, _, _ = driven(Ghost(circle_lap()), 5.0, offset=1.0, heading_error=0.3, speed=2.0)
    away = np.abs(radius - LINE)
    assert away[0].max() > 0.8
    assert away[-25:].max() < 0.08


def test_it_goes_on_past_the_end_of_the_recording() -> None:
    """Between the last point and the first it does what it does anywhere else, also where points are far apart."""
    angle = np.linspace(-0.5, 0.5, 101)
    pose = np.stack([LINE * np.cos(angle), LINE * np.sin(angle), angle + 0.5 * math.pi], axis=1)
    many = {"vel": np.tile([2.5, 0.0, 0.0], (101, 1)), "action_span": np.tile([0.4, 0.0, 6.0], (101, 1))}
    steer, speed = Ghost(circle_lap(40)).act({"pose": pose, **many}).T
    np.testing.assert_allclose(steer, math.atan(0.33 / LINE) / 0.4, atol=0.03)
    preview = 2.5 * PREVIEW / LINE
    np.testing.assert_allclose(3.0 * (speed + 1.0), recorded_speed(angle + preview), atol=0.02)


def test_a_file_brings_back_the_same_lap(tmp_path: Path) -> None:
    lap = circle_lap()
    path = Ghost(lap).save(tmp_path / "laps" / "fast.csv")
    again = Ghost.load(path)
    assert again.name == "fast"
    np.testing.assert_allclose(again.lap, lap, rtol=1e-5, atol=1e-12)
    assert path.read_text().splitlines()[0] == "t_s,x_m,y_m,yaw_rad,vx_mps"


def oval() -> Track:
    """45 m around, with corners that a car must brake for."""
    angle = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    line = Centerline.from_points(np.stack([9.0 * np.cos(angle), 5.0 * np.sin(angle)], axis=1), 1.1, 1.1)
    occupancy, origin = draw_walls(line, 0.05, 0.5)
    return Track("oval", occupancy, 0.05, origin, line)


@pytest.mark.parametrize("v_max", [3.0, 6.0, 7.0])
def test_a_ghost_of_a_driver_is_as_fast_as_the_driver(v_max: float) -> None:
    """Also where the driver itself runs wide, up to 0.7 m at 7 m/s, on a track that is 1.1 m wide to each side."""
    track, vehicle = oval(), VehicleParams(v_max=v_max)
    alone = TASK.model_copy(update={"vehicle": vehicle, "speed_range": (0.0, v_max)})
    lap = record_lap(PurePursuit(), alone, track)
    task = standing_starts(alone, [track], laps=2)
    rows = [evaluate(driver, task, [track], episodes=3, seed=0) for driver in (PurePursuit(), Ghost(lap))]
    assert rows[1]["outcome"].tolist() == ["finished"] * 3
    np.testing.assert_allclose(rows[1]["lap_time_s"], rows[0]["lap_time_s"], rtol=0.01)


def test_a_recording_is_one_lap_from_line_to_line() -> None:
    track = oval()
    lap = record_lap(PurePursuit(), TASK, track)
    times = lap[:, COLUMNS.index("t_s")]
    np.testing.assert_allclose(np.diff(times), ACTION, atol=1e-9)
    assert 0.0 < times[0] <= ACTION
    timed = evaluate(PurePursuit(), standing_starts(TASK, [track], laps=1), [track], episodes=1, seed=0)["lap_time_s"]
    assert 0.0 <= timed[0] - times[-1] <= 1.1 * ACTION
    s, _ = track.centerline.to_frenet(lap[:, 1], lap[:, 2])
    step = 1.2 * ACTION * lap[:, 4].max()
    assert 0.0 <= s[0] < step
    assert track.centerline.length - step < s[-1] < track.centerline.length
    assert (np.diff(s) > 0.0).all()


def test_a_lap_is_recorded_alone_and_from_the_seed() -> None:
    track = ring(RADIUS)
    alone, again, other = (record_lap(PurePursuit(), TASK, track, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(alone, again)
    assert len(alone) != len(other) or not np.array_equal(alone, other)
    crowded = TASK.model_copy(update={"num_cars": 3, "opponent_speed": 0.5})
    np.testing.assert_array_equal(record_lap(PurePursuit(), crowded, track, 0), alone)


def test_a_driver_that_completes_no_lap_is_named() -> None:
    def straight(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.tile([0.0, -0.5], (len(observation["vel"]), 1))

    driver = FunctionDriver(straight, "bullet", ("vel",))
    with pytest.raises(OutlapError, match=r"driver bullet: completed no lap of ring5 \(crash after \d+ m\)"):
        record_lap(driver, TASK, ring(RADIUS))


HEADER = ",".join(COLUMNS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "broken.csv: cannot be read as a recorded lap: .*No such file"),
        ("", "broken.csv: cannot be read as a recorded lap"),
        ("x_m,y_m\n" + "1,2\n" * 10, "broken.csv: .* its first line is 'x_m,y_m'; must be 't_s,x_m"),
        (f"{HEADER}\n" + "0,1,2,3,4\n" * 9 + "0,1,two,3,4\n", "broken.csv: .*'two'"),
        (f"{HEADER}\n" + "0,1,2,3,4\n" * 9 + "0,1,2,3\n", "broken.csv: cannot be read as a recorded lap"),
        (f"{HEADER}\n" + "0,1,2,3,4\n" * 3, r"broken: the lap has shape \(3, 5\); must be \(8 or more, 5\)"),
        (HEADER, r"broken: the lap has shape \(0,\)"),
        (f"{HEADER}\n" + "0,1,2,3,4\n" * 9 + "0,1,nan,3,4\n", "broken: y_m of point 9 is nan"),
        (f"{HEADER}\n" + "0,1,2,3,inf\n" * 9, "broken: vx_mps of point 0 is inf"),
        (f"{HEADER}\n" + "0,1,2,3,4\n" * 9, "broken: all points of the lap are in one place"),
    ],
    ids=["missing", "empty", "header", "text", "ragged", "short", "pointless", "nan", "infinite", "standing"],
)
def test_a_broken_file_is_named(tmp_path: Path, content: str | None, message: str) -> None:
    path = tmp_path / "broken.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(OutlapError, match=message) as error:
        Ghost.load(path)
    assert "\n" not in str(error.value)


def test_it_asks_for_what_it_needs_and_for_no_scan() -> None:
    ghost = Ghost(circle_lap())
    env = make_race_vector(2, tracks=[ring(RADIUS)], beams=0)
    env.reset(seed=0)
    assert ghost.act(observe(env.race, 0, ghost.observation_terms, ghost.scale_observations)).shape == (2, 2)
