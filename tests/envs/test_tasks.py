"""What is drawn in every episode: tracks and parameters; and that held-out tasks stay held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from any_worlds import FIELDS, PARTS
from outlap.config import bounds
from outlap.envs.keywords import make_race_vector
from outlap.envs.tasks import TaskSet, TaskSplit
from outlap.errors import OutlapError
from outlap.simulator.seeding import world_keys
from outlap.simulator.vehicle import (
    DERIVED,
    N_PARAMS,
    NAMES,
    AxleTyres,
    LidarParams,
    PacejkaTyre,
    VehicleParams,
    to_records,
    to_values,
)
from outlap.track import catalog
from outlap.track.catalog import load_tracks
from outlap.track.generate import BUILTIN_HELD_OUT, BUILTIN_TRAIN
from outlap.track.map_io import write_track
from outlap.track.track import Track


def test_there_is_a_field_for_every_column():
    assert sorted(name for _, name in FIELDS) == sorted(set(NAMES) - set(DERIVED))


def with_range(part: str, name: str) -> tuple[dict, float, float]:
    """Configurations in which one parameter has a range around its default."""
    default = bounds(getattr(PARTS[part](), name))[0]
    low, high = sorted((0.8 * default, 1.1 * default)) if default else (0.001, 0.04)
    if name == "grip_share":
        low, high = 0.7, 1.0
    if part == "axles":
        return {"vehicle": VehicleParams(axles=AxleTyres(**{name: (low, high)}))}, low, high
    if part == "tyre":
        return {"vehicle": VehicleParams(tyre=PacejkaTyre(**{name: (low, high)}))}, low, high
    return {part: PARTS[part](**{name: (low, high)})}, low, high


@pytest.mark.parametrize(("part", "name"), FIELDS)
def test_a_parameter_with_a_range_is_uniform_in_it_and_the_others_stay(ellipse, part, name):
    """Car by car, world by world, episode by episode; of vehicle, tyre, actuators and scanner alike."""
    config, low, high = with_range(part, name)
    fixed = TaskSet((ellipse,)).draw(world_keys([0]), np.array([1]), 1).params[0, 0]
    worlds, episodes = 400, 3
    keys = world_keys(range(worlds))
    draws = [TaskSet((ellipse,), **config).draw(keys, np.full(worlds, e), 2).params for e in range(1, episodes + 1)]
    params = to_values(np.stack(draws))  # (episodes, worlds, cars, N_PARAMS)
    fixed = to_values(fixed)
    chosen = NAMES.index(name)
    others = np.delete(np.arange(N_PARAMS), chosen)
    np.testing.assert_array_equal(params[..., others], np.broadcast_to(fixed[others], params[..., others].shape))

    values = params[..., chosen]
    assert values.min() >= np.float32(low)
    assert values.max() <= np.float32(high)
    test = stats.kstest(values.ravel(), "uniform", args=(low, high - low))
    assert test.pvalue > 1e-5  # 2400 draws
    assert len(np.unique(values)) > 2300
    # Independent of the other car, and of the episode before: |r| of 1200 or 800 pairs stays below 5 sigma.
    assert abs(np.corrcoef(values[:, :, 0].ravel(), values[:, :, 1].ravel())[0, 1]) < 0.15
    assert abs(np.corrcoef(values[0].ravel(), values[1].ravel())[0, 1]) < 0.18


def test_parameters_are_independent_of_each_other_and_of_the_track(ellipse, circle):
    vehicle = VehicleParams(mu=(0.5, 1.1), m=(3.0, 4.0))
    tasks = TaskSet((ellipse, circle), vehicle, lidar=LidarParams(noise_std=(0.0, 0.1)))
    tracks, params, _ = tasks.draw(world_keys(range(3000)), np.ones(3000, int), 1)
    drawn = np.stack([tracks, *(params[name][:, 0] for name in ("mu", "m", "noise_std"))])
    off_diagonal = np.corrcoef(drawn)[np.triu_indices(4, 1)]
    assert np.abs(off_diagonal).max() < 0.09  # 5 sigma


def test_every_track_is_as_likely(ellipse, circle, big_circle):
    tasks = TaskSet((ellipse, circle, big_circle))
    keys = world_keys(range(3000))
    first, second = (tasks.draw(keys, np.full(3000, episode), 1).tracks for episode in (1, 2))
    for tracks in (first, second):
        assert stats.chisquare(np.bincount(tracks, minlength=3)).pvalue > 1e-5
    assert np.mean(first == second) == pytest.approx(1 / 3, abs=0.05)


def test_draws_do_not_depend_on_the_company(ellipse, circle):
    """Adding cars or worlds leaves the draws of the others as they were."""
    tasks = TaskSet((ellipse, circle), VehicleParams(mu=(0.5, 1.1)))
    tracks, params, _ = tasks.draw(world_keys(range(8)), np.arange(8), 1)
    some = np.array([2, 5])
    fewer_tracks, more_cars, _ = tasks.draw(world_keys(some.tolist()), some, 4)
    np.testing.assert_array_equal(fewer_tracks, tracks[some])
    np.testing.assert_array_equal(more_cars[:, :1], params[some])


def test_the_environment_draws_anew_in_every_episode(ellipse):
    """The vehicle in the info is the one that the simulator drives; fixed ranges stay fixed across resets."""
    env = make_race_vector(
        30, tracks=[ellipse], num_cars=2, beams=0, vehicle={"mu": {"min": 0.5, "max": 1.1}},
        termination={"time_limit": 0.02},
    )  # fmt: skip
    _, info = env.reset(seed=0)
    frictions, previous = [], None
    for _ in range(20):
        vehicle = info["vehicle"]
        np.testing.assert_array_equal(vehicle, to_values(env.race.worlds.params))
        assert vehicle.shape == (30, 2, N_PARAMS)
        np.testing.assert_array_equal(to_records(vehicle)["m"], np.float32(3.74))
        if previous is not None:
            assert (to_records(vehicle)["mu"] != to_records(previous)["mu"]).all()
        frictions.append(to_records(vehicle)["mu"])
        previous = vehicle.copy()
        env.step(np.zeros((30, 2)))
        *_, info = env.step(np.zeros((30, 2)))
    values = np.stack(frictions)
    assert stats.kstest(values.ravel(), "uniform", args=(0.5, 0.6)).pvalue > 1e-5
    assert len(np.unique(values)) > 1190


def test_friction_reaches_the_tyres(big_circle, put):
    """Four fifths of the cornering speed on dry ground, on ice: the car with little grip runs wide."""
    env = make_race_vector(1, tracks=[big_circle], num_cars=1, beams=0, vehicle={"mu": (0.2, 1.0489)})
    offsets = {}
    for mu in (0.2, 1.0489):
        env.reset(seed=0)
        params = env.race.worlds.params.copy()
        params["mu"] = mu
        put(env, [0.0, 0.6, 0.0, 6.0], params)
        for _ in range(40):
            env.step(np.array([[0.1, -0.12]]))
        offsets[mu] = env.race.worlds.frenet[0, 0, 1]
    assert offsets[0.2] < offsets[1.0489] - 0.1


def test_an_actuator_delay_is_drawn_and_holds_the_command_back(ellipse):
    """Full lock at once: the wheels move after each world's own delay."""
    env = make_race_vector(24, tracks=[ellipse], beams=0, actuators={"steer_delay": (0.0, 0.08)})
    _, info = env.reset(seed=3)
    delay = to_records(info["vehicle"])["steer_delay"][:, 0]
    assert len(np.unique(delay)) == 24
    first = np.full(24, -1)
    for step in range(12):
        env.step(np.tile([1.0, -0.6], (24, 1)))
        moved = (env.race.worlds.state[:, 0, 2] != 0.0) & (first < 0)
        first[moved] = step
    np.testing.assert_array_equal(first, np.floor(delay / 0.01 + 0.5))
    assert len(set(first)) > 4


def test_noise_and_mount_are_drawn_and_reach_the_scan(big_circle, put):
    """Standing still on a circle: a scan's standard deviation is its world's, its middle range the mount's."""
    env = make_race_vector(
        12, tracks=[big_circle], beams=541, observation="scan",
        lidar={"noise_std": (0.01, 0.2), "mount_x": (-0.2, 0.4), "dropout": 0.0}, vehicle={"mu": (0.5, 1.0)},
    )  # fmt: skip
    put(env, [3.0, 0.0, 0.0, 0.0])
    noise, mount = (env.race.worlds.params[name][:, 0] for name in ("noise_std", "mount_x"))
    assert len(np.unique(noise)) == len(np.unique(mount)) == 12
    scans = np.stack([env.step(np.tile([0.0, -0.6], (12, 1)))[0]["scan"] for _ in range(60)])
    middle = scans[..., 250:290]
    np.testing.assert_allclose(middle.std(axis=0).mean(axis=1), noise, rtol=0.05)
    # Straight ahead the outer wall, 9.2 m from the centre: from m in front of the car, on a tangent of 8 m.
    ahead = np.sqrt(9.2**2 - 8.0**2) - mount
    np.testing.assert_allclose(scans[..., 270].mean(axis=0), ahead, atol=0.2)
    assert np.corrcoef(scans[..., 265:276].mean(axis=(0, 2)), -mount)[0, 1] > 0.95


def test_noise_is_drawn_anew_in_every_scan_car_episode_and_world(ellipse):
    """What a noisy scanner adds to a true one, from the same starts: no two of them alike."""
    config = {
        "tracks": [ellipse],
        "num_cars": 2,
        "beams": 60,
        "observation": "scan",
        "termination": {"time_limit": 0.03},
    }
    true, noisy = make_race_vector(3, **config), make_race_vector(3, **config, lidar={"noise_std": 0.05})
    true.reset(seed=0)
    noisy.reset(seed=0)
    noise = []
    for _ in range(12):
        noise.append((noisy.race.worlds.scan - true.race.worlds.scan).reshape(6, 60))
        true.step(np.zeros((3, 2)))
        noisy.step(np.zeros((3, 2)))
    assert noisy.race.worlds.time.max() == 0.0, "the test needs several episodes"
    correlation = np.corrcoef(np.concatenate(noise))[np.triu_indices(72, 1)]
    assert np.abs(correlation).max() < 0.7  # 60 beams: 5 sigma


def test_a_split_with_a_track_on_both_sides_is_refused(ellipse, circle, big_circle):
    TaskSplit(TaskSet((ellipse, circle)), TaskSet((big_circle,)))
    with pytest.raises(OutlapError, match=r"ring4.*both trained on and held out"):
        TaskSplit(TaskSet((ellipse, circle)), TaskSet((circle, big_circle)))
    with pytest.raises(OutlapError, match="ring4"):  # another object, the same circuit
        TaskSplit(TaskSet((circle,)), TaskSet((replace(circle),)))
    for changed in (circle.reversed(), circle.mirrored(), circle.reversed().mirrored()):  # the same, the other way
        with pytest.raises(OutlapError, match="ring4"):
            TaskSplit(TaskSet((ellipse, changed)), TaskSet((circle,)))


def test_a_set_without_tracks_is_refused():
    with pytest.raises(OutlapError, match="tracks"):
        TaskSet(())


def test_held_out_tracks_are_unreachable_from_training(ellipse, circle, big_circle):
    """Every way in which a training set can yield a track: 20,000 draws, and resets of an environment."""
    split = TaskSplit(TaskSet((ellipse, circle)), TaskSet((big_circle,)))
    keys = world_keys(range(2000))
    drawn = set()
    for episode in range(10):
        numbers = split.train.draw(keys, np.full(2000, episode), 1).tracks
        drawn |= {split.train.tracks[number].name for number in numbers}
    assert drawn == {"ellipse", "ring4"}
    env = make_race_vector(50, tracks=split.train.tracks, beams=0, termination={"time_limit": 0.01})
    _, info = env.reset(seed=0)
    seen = set(info["track"])
    for _ in range(20):
        *_, info = env.step(np.zeros((50, 2)))
        seen |= set(info["track"]) | set(info["final_info"]["track"])
    assert seen == {"ellipse", "ring4"}
    assert [track.name for track in env.race.simulator.tracks] == ["ellipse", "ring4"]


def test_the_built_in_sets_do_not_overlap_and_the_default_is_for_training(monkeypatch, ellipse):
    """By default the training set, all of it and nothing else."""
    assert not set(BUILTIN_TRAIN) & set(BUILTIN_HELD_OUT)
    asked_for = []

    def load(name: str) -> Track:  # the real ones take seconds to draw
        asked_for.append(name)
        return replace(ellipse, name=name)

    monkeypatch.setattr(catalog, "load_track", load)
    env = make_race_vector(1, beams=0)
    assert tuple(asked_for) == BUILTIN_TRAIN
    assert env.config.tracks == BUILTIN_TRAIN
    assert [track.name for track in env.race.simulator.tracks] == list(BUILTIN_TRAIN)


def test_augmented_tracks_are_driven_the_other_way_round_and_mirrored(ellipse, follow):
    """Four circuits of one: two turn left, two turn right, and the car laps them all."""
    env = make_race_vector(
        40, tracks=[ellipse], augment_tracks=True, beams=0, observation="curvature_ahead", control_interval=5,
        termination={"time_limit": 0.0}, start={"speed": 3.0},
    )  # fmt: skip
    observation, info = env.reset(seed=0)
    left = observation["curvature_ahead"].mean(axis=1) > 0.0
    names = ["ellipse", "ellipse reversed", "ellipse mirrored", "ellipse reversed mirrored"]
    for name, turns_left in zip(names, (True, False, False, True), strict=True):
        assert (info["track"] == name).any()
        assert (left[info["track"] == name] == turns_left).all()
    for _ in range(320):  # at 3 m/s
        _, _, terminated, truncated, info = env.step(follow(env, -0.36))
        assert not (terminated | truncated).any()
    assert info["progress_m"].min() > 0.95 * ellipse.centerline.length
    assert env.config.tracks == ("ellipse",)


def test_tracks_are_names_folders_or_tracks(ellipse, tmp_path):
    folder = write_track(ellipse, tmp_path / "ellipse")
    for given in (ellipse, [ellipse], (ellipse,), str(folder), [str(folder)], folder, [folder]):
        env = make_race_vector(1, tracks=given, beams=0)
        _, info = env.reset(seed=0)
        assert info["track"] == ["ellipse"]
        assert env.config.tracks in (("ellipse",), (str(folder),))
    assert load_tracks([ellipse])[0] is ellipse


@pytest.mark.parametrize("tracks", [3, [3], None, [None], {"a": 1}, ["no such circuit anywhere"]])
def test_what_is_not_a_track_is_refused(tracks):
    with pytest.raises(OutlapError, match="track"):
        make_race_vector(1, tracks=tracks, beams=0)
