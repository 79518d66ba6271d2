"""A recording is the very episode that `evaluate` has, and what is read back is what was written."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from outlap.drivers.find import find_drivers
from outlap.envs.race import EGO
from outlap.envs.race_config import RaceConfig, StartConfig
from outlap.errors import OutlapError
from outlap.evaluation.frame import YAW, X, Y
from outlap.evaluation.protocol import standing_starts
from outlap.evaluation.recorder import record_episode
from outlap.evaluation.recording import ARRAYS, Recording
from outlap.evaluation.rollout import evaluate
from outlap.simulator.vehicle import VehicleParams
from synthetic_tracks import ring

TRACK = ring(radius=6.0, half_width=1.5)
RACE = RaceConfig(
    num_cars=3, opponents=("pure-pursuit",), opponent_speed=2.0, beams=200, vehicle=VehicleParams(v_max=5.0),
    start=StartConfig(formation="behind"),
)  # fmt: skip
TASK = standing_starts(RACE, [TRACK], laps=2, time_limit=40.0)
(DRIVER,) = find_drivers(["follow-the-gap"], TASK.field_of_view, split=None)
(BLIND,) = find_drivers(["pure-pursuit"], TASK.field_of_view, split=None)


@pytest.fixture(scope="module")
def row():
    """An episode as `evaluate` has it."""
    return evaluate(DRIVER, TASK, [TRACK], 1, seed=3, lap_time_ratios=False).iloc[0]


@pytest.fixture(scope="module")
def recording(row) -> Recording:
    return record_episode(DRIVER, TASK, TRACK, int(row["seed"]))


def test_it_is_the_episode_that_evaluate_has(row, recording: Recording):
    info = recording.info
    assert info.outcome == row["outcome"]
    assert recording.seconds == pytest.approx(row["duration_s"], abs=1e-3)
    assert len(recording.time) == row["episode_steps"] + 1
    assert recording.rewards.sum() == pytest.approx(row["episode_return"], rel=1e-5)
    assert recording.distance[-1, EGO] - recording.distance[0, EGO] == pytest.approx(row["progress_m"], rel=1e-5)
    assert recording.laps[-1, EGO] == row["completed_laps"]
    assert places(recording, "overtake") == row["overtakes"] > 0
    assert places(recording, "place lost") == row["places_lost"]
    assert info.cast.drivers == ("follow-the-gap", "pure-pursuit 1", "pure-pursuit 2")


def places(recording: Recording, kind: str) -> int:
    """Of all events of a kind together: "… gains a place", "… gains 2 places"."""
    words = [event.text.split()[-2] for event in recording.info.events if event.kind == kind]
    return sum(1 if word == "a" else int(word) for word in words)


@pytest.mark.parametrize("fate", ["park", "remove", "respawn"])
def test_a_rivals_crash_is_an_event(fate: str):
    brief = standing_starts(RACE, [TRACK], laps=0, time_limit=6.0)
    task = brief.model_copy(
        update={"opponents": ("recordings:straight_on",), "opponent_code": True, "opponent_crash": fate, "num_cars": 2}
    )
    row = evaluate(DRIVER, task, [TRACK], 1, seed=0, lap_time_ratios=False).iloc[0]
    recording = record_episode(DRIVER, task, TRACK, int(row["seed"]))
    crashes = [event for event in recording.info.events if event.kind == "contact"]
    assert len(crashes) == row["opponent_crashes"] > 0
    assert all(event.car == 1 for event in crashes)


def test_a_driver_without_a_scanner_races_the_same_with_one_to_look_at():
    task = standing_starts(RaceConfig(beams=30), [TRACK], laps=0, time_limit=2.0)
    row = evaluate(BLIND, task, [TRACK], 1, seed=5, lap_time_ratios=False).iloc[0]
    recording = record_episode(BLIND, task, TRACK, int(row["seed"]))
    assert recording.scan.shape[1] == 30
    assert recording.distance[-1, EGO] - recording.distance[0, EGO] == pytest.approx(row["progress_m"], rel=1e-5)


def test_events_are_when_they_happen(recording: Recording):
    laps = [event for event in recording.info.events if event.kind == "lap" and event.car == EGO]
    completed = recording.time[np.flatnonzero(np.diff(recording.laps[:, EGO])) + 1]
    assert [event.time_s for event in laps] == pytest.approx(completed.tolist(), abs=1e-4)
    assert len(laps) > 0
    assert f"{float(np.nanmax(recording.lap_time[:, EGO])):.2f} s" in " ".join(event.text for event in laps)
    assert recording.info.events[0].kind == "start"
    assert recording.info.events[-1].kind == "end"
    assert recording.info.events[-1].time_s == pytest.approx(recording.time[-1])


def test_a_scan_is_of_the_walls(recording: Recording):
    """A beam ends on a wall or at a car: from the ring's middle that is one of its two radii."""
    frame = recording.frame(0)
    x, y, yaw = frame.motion[EGO, [X, Y, YAW]]
    angles = yaw + np.linspace(-0.5, 0.5, len(frame.scan)) * recording.info.cast.field_of_view
    ends = np.hypot(x + frame.scan * np.cos(angles), y + frame.scan * np.sin(angles))
    on_a_wall = np.minimum(np.abs(ends - 4.5), np.abs(ends - 7.5)) < 0.1
    assert on_a_wall.mean() > 0.7


def test_between_two_frames_it_moves_evenly(recording: Recording):
    number = len(recording.time) // 2
    before, after = recording.frame(number), recording.frame(number + 1)
    middle = recording.at(0.5 * (before.time + after.time) - float(recording.time[0]))
    np.testing.assert_allclose(middle.motion[:, [X, Y]], 0.5 * (before.motion + after.motion)[:, [X, Y]], atol=1e-5)
    turned = np.angle(np.exp(1j * (middle.motion[:, YAW] - before.motion[:, YAW])))
    whole = np.angle(np.exp(1j * (after.motion[:, YAW] - before.motion[:, YAW])))
    np.testing.assert_allclose(turned, 0.5 * whole, atol=1e-5)
    assert recording.at(-1.0).time == recording.frame(0).time
    assert recording.at(1e9).time == recording.frame(-1).time


def test_what_is_read_is_what_was_written(recording: Recording, tmp_path: Path):
    read = Recording.load(recording.save(tmp_path / "a.npz"))
    assert read.info == recording.info
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(recording, name))


def rewritten(path: Path, **changes: np.ndarray) -> Path:
    """The file with some arrays replaced."""
    with np.load(path) as archive:
        arrays = {**{name: archive[name] for name in archive.files}, **changes}
    other = path.with_name("changed.npz")
    np.savez(other, **arrays)  # type: ignore[arg-type]
    return other


def test_broken_files_are_refused_with_the_reason(recording: Recording, tmp_path: Path):
    path = recording.save(tmp_path / "a.npz")
    info = json.loads(recording.info.model_dump_json())
    words = np.frombuffer(json.dumps({**info, "outcome": 3}).encode(), np.uint8)
    escape = np.frombuffer(json.dumps({**info, "title": "\x1b[31m"}).encode(), np.uint8)
    nobody = np.frombuffer(json.dumps({**info, "cast": {**info["cast"], "drivers": []}}).encode(), np.uint8)
    for changes, said in (
        ({"motion": recording.motion[:-1]}, "motion has shape"),
        ({"motion": recording.motion.astype(str)[..., 0]}, "motion has shape"),
        ({"action": np.full(recording.action.shape, "x")}, "is no recording"),
        ({"time": recording.time[::-1]}, "time does not grow"),
        ({"context": np.full((len(recording.time), 3), np.nan)}, "context holds numbers that are not finite"),
        ({"motion": np.full_like(recording.motion, np.nan)}, "motion holds numbers that are not finite"),
        ({"scan": recording.scan[0]}, "scan has shape"),
        ({"info": words}, "outcome"),
        ({"info": nobody}, "0 drivers"),
        ({"info": escape}, "title.*characters that cannot be shown"),
    ):
        with pytest.raises(OutlapError, match=said):
            Recording.load(rewritten(path, **changes))
    with pytest.raises(OutlapError, match="no such file"):
        Recording.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(OutlapError, match=r"text\.npz: is no recording"):
        Recording.load(tmp_path / "text.npz")


def test_no_code_runs_when_a_file_is_read(recording: Recording, tmp_path: Path):
    ran = tmp_path / "ran"

    class Hostile:
        def __reduce__(self):
            return Path.touch, (ran,)

    path = recording.save(tmp_path / "a.npz")
    pickled = io.BytesIO()
    np.save(pickled, np.array([Hostile()], dtype=object), allow_pickle=True)
    other = tmp_path / "hostile.npz"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w") as target:
        for name in source.namelist():
            target.writestr(name, pickled.getvalue() if name == "time.npy" else source.read(name))
    with pytest.raises(OutlapError, match="is no recording"):
        Recording.load(other)
    assert not ran.exists()
