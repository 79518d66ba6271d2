"""The vector environment: against single ones, its buffers, autoreset, seeds, and what it refuses."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from outlap.envs.keywords import make_race, make_race_vector
from outlap.errors import OutlapError


def assert_equal(a, b, where: str) -> None:
    """Nested dicts and arrays, bit for bit; NaN equals NaN."""
    if isinstance(a, dict):
        assert set(a) == set(b), where
        for name in a:
            assert_equal(a[name], b[name], f"{where}.{name}")
    else:
        np.testing.assert_array_equal(a, b, err_msg=where)


@pytest.fixture
def varied(ellipse, circle, big_circle) -> dict:
    """Everything that is drawn at random, and short episodes."""
    return {
        "tracks": [ellipse, circle, big_circle],
        "num_cars": 2,
        "beams": 12,
        "control_interval": 2,
        "observation": (
            "scan",
            "pose",
            "vel",
            "heading",
            "previous_action",
            "previous_reward",
            "frenet",
            "curvature_ahead",
        ),
        "vehicle": {"mu": (0.5, 1.1), "m": (2.5, 5.0), "tyre": {"p_dy1": (0.8, 1.2)}},
        "actuators": {"steer_delay": (0.0, 0.05), "speed_lag": (0.0, 0.2)},
        "lidar": {"noise_std": (0.0, 0.1), "dropout": (0.0, 0.2), "mount_x": (0.0, 0.3)},
        "opponent_speed": (1.0, 4.0),
        "start": {"speed": (0.0, 4.0)},
        "termination": {"time_limit": 0.9},
        # A curriculum counts the steps of all worlds together, so it would differ: see test_rewards.
        "reward": {"preset": "fast", "collision_max": 1.0},
    }


def test_it_is_single_environments_stepped_one_by_one(varied):
    """Same seeds, same trajectories bit for bit, through resets."""
    worlds = 4
    together = make_race_vector(worlds, **varied)
    alone = [make_race(**varied) for _ in range(worlds)]
    observation, info = together.reset(seed=11)
    for world, env in enumerate(alone):
        assert_equal({k: v[world] for k, v in observation.items()}, env.reset(seed=11 + world)[0], f"reset {world}")
    rng = np.random.default_rng(0)
    episodes = np.zeros(worlds, int)
    outcomes, tracks = set(), set()
    for step in range(200):
        actions = rng.uniform(-1.0, 1.0, (worlds, 2)).astype(np.float32)
        observation, rewards, terminated, truncated, info = together.step(actions)
        for world, env in enumerate(alone):
            where = f"step {step}, world {world}"
            own, reward, crashed, cut, own_info = env.step(actions[world])
            assert (reward, crashed, cut) == (rewards[world], terminated[world], truncated[world]), where
            batch = info
            if crashed or cut:
                episodes[world] += 1
                outcomes.add(own_info["outcome"])
                assert_equal(info["final_obs"][world], own, where + " final_obs")
                assert_equal(_of(info["final_info"], world), own_info, where + " final_info")
                own, own_info = env.reset()
                tracks.add(own_info["track"])
            assert_equal({k: v[world] for k, v in observation.items()}, own, where)
            assert_equal(_of(batch, world), own_info, where + " info")
    assert episodes.min() >= 3
    assert outcomes == {"crash", "timeout"}
    assert tracks == {"ellipse", "ring4", "ring8"}


def _of(info: dict, world: int) -> dict:
    return {k: v[world] for k, v in info.items() if k[0] != "_" and "final" not in k and info[f"_{k}"][world]}


def test_the_same_seed_gives_the_same_run_again(varied):
    def run(seed):
        env = make_race_vector(3, **varied)
        out = [env.reset(seed=seed)]
        rng = np.random.default_rng(4)
        out += [env.step(rng.uniform(-1.0, 1.0, (3, 2))) for _ in range(120)]
        return out

    first, second, other = run(5), run(5), run(6)
    for step, (a, b) in enumerate(zip(first, second, strict=True)):
        assert_equal(a[0], b[0], f"observation {step}")
        if step:
            for part in (1, 2, 3):
                np.testing.assert_array_equal(a[part], b[part])
    assert not np.array_equal(first[0][0]["pose"], other[0][0]["pose"])


def test_what_is_returned_is_never_a_live_buffer(varied):
    """Neither stepping on nor resetting changes what was returned before."""
    env = make_race_vector(3, **varied)
    rng = np.random.default_rng(0)
    returned: list[tuple] = [env.reset(seed=0)]
    kept = [copy.deepcopy(returned[0])]
    for _ in range(120):
        returned.append(env.step(rng.uniform(-1.0, 1.0, (3, 2))))
        kept.append(copy.deepcopy(returned[-1]))
    returned.append(env.reset())
    assert any("final_obs" in step[-1] for step in returned)
    for step, (now, then) in enumerate(zip(returned, kept, strict=False)):
        for part, (a, b) in enumerate(zip(now, then, strict=True)):
            if isinstance(a, dict) and "final_obs" in a:
                for mine, copied in zip(a.pop("final_obs"), b.pop("final_obs"), strict=True):
                    assert (mine is None) == (copied is None)
                    if mine is not None:
                        assert_equal(mine, copied, f"step {step} final_obs")
            assert_equal(a, b, f"step {step} part {part}")


def test_writing_into_what_is_returned_changes_nothing(varied):
    """The run goes on as if nobody had scribbled over its arrays."""
    runs = []
    for scribble in (False, True):
        env = make_race_vector(3, **varied)
        rng = np.random.default_rng(0)
        step = env.reset(seed=0)
        run = []
        for _ in range(120):
            run.append(copy.deepcopy(step[:-1]))
            if scribble:
                _scribble(step)
            actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
            step = env.step(actions)
            if scribble:
                actions[:] = 99.0
        runs.append((run, env.race.worlds.state.copy()))
    for step, (a, b) in enumerate(zip(runs[0][0], runs[1][0], strict=True)):
        for mine, other in zip(a, b, strict=True):
            assert_equal(mine, other, f"step {step}")
    np.testing.assert_array_equal(runs[0][1], runs[1][1])


def _scribble(value) -> None:
    if isinstance(value, dict):
        for each in value.values():
            _scribble(each)
    elif isinstance(value, (tuple, list)):
        for each in value:
            _scribble(each)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "fiub":
            value[...] = 1
        elif value.dtype == object:
            for each in value:
                _scribble(each)


def test_the_final_observation_is_the_last_before_the_reset(ellipse, follow):
    """Same step, told apart by the pose: the final one continues the drive, the returned one starts anew."""
    env = make_race_vector(3, tracks=[ellipse], beams=5, termination={"time_limit": 0.5}, start={"speed": 3.0})
    observation, _ = env.reset(seed=0)
    for step in range(50):
        before = observation["pose"]
        observation, _, terminated, truncated, info = env.step(follow(env, -0.5))
        assert not terminated.any()
        assert truncated.all() == (step == 49)
        assert ("final_obs" in info) == (step == 49)
    for name in ("_final_obs", "_final_info"):
        np.testing.assert_array_equal(info[name], True)
    for world in range(3):
        final = info["final_obs"][world]
        assert set(final) == set(observation)
        moved = np.hypot(*(final["pose"] - before[world])[:2])
        assert moved == pytest.approx(final["vel"][0] * 0.01, abs=2e-3)
        assert np.hypot(*(observation["pose"][world] - final["pose"])[:2]) > 0.1
        assert observation["vel"][world, 0] == pytest.approx(3.0)
        assert not np.array_equal(final["scan"], observation["scan"][world])


def test_only_the_worlds_that_ended_are_reset(ellipse, put):
    """World 1 starts towards the wall; the others go on undisturbed."""
    env = make_race_vector(3, tracks=[ellipse], beams=5)
    put(env, np.array([[[0.0, 0, 0, 2]], [[0, 0, 1.2, 4]], [[5, 0, 0, 2]]], float))
    for _ in range(60):
        before = env.race.worlds.time.copy()
        _, _, terminated, truncated, info = env.step(np.tile([0.3, -0.4], (3, 1)))
        if terminated.any():
            break
    np.testing.assert_array_equal(terminated, [False, True, False])
    assert not truncated.any()
    np.testing.assert_array_equal(info["_final_obs"], [False, True, False])
    np.testing.assert_array_equal(info["_final_info"], [False, True, False])
    assert info["final_obs"][0] is None
    assert info["final_info"]["outcome"][1] == "crash"
    np.testing.assert_array_equal(info["final_info"]["_outcome"], [False, True, False])
    np.testing.assert_array_equal(info["outcome"], ["", "", ""])
    np.testing.assert_allclose(info["time_s"], [before[0] + 0.01, 0.0, before[2] + 0.01])
    np.testing.assert_array_equal(info["episode_steps"] > 0, [True, False, True])


def test_a_control_interval_is_that_many_physics_steps_of_the_same_action(varied):
    fine, coarse = (
        make_race_vector(3, **{**varied, "num_cars": 1, "control_interval": n, "termination": {"time_limit": 0.0}})
        for n in (1, 4)
    )
    fine.reset(seed=8)
    coarse.reset(seed=8)
    rng = np.random.default_rng(0)
    crashed = np.zeros(3, bool)
    for _ in range(12):
        actions = rng.uniform(-0.5, 0.5, (3, 2)).astype(np.float32)
        rewards = np.zeros(3)
        for _ in range(4):
            a, last, terminated, _, info = fine.step(actions)
            crashed |= terminated
            rewards += last
        b, reward, terminated, _, coarse_info = coarse.step(actions)
        if crashed.any():
            break
        np.testing.assert_allclose(b.pop("previous_reward")[:, 0], reward, rtol=1e-6)
        np.testing.assert_allclose(a.pop("previous_reward")[:, 0], last, rtol=1e-6)
        assert_equal(a, b, "observation")
        np.testing.assert_array_equal(fine.race.worlds.state, coarse.race.worlds.state)
        np.testing.assert_array_equal(info["time_s"], coarse_info["time_s"])
        np.testing.assert_allclose(rewards, reward, rtol=1e-9, atol=1e-12)  # progress adds up, and so does |change|
    else:
        assert coarse_info["time_s"] == pytest.approx(0.48)
        assert coarse.metadata["render_fps"] == 25
        return
    pytest.fail("the test needs a drive without a crash")


def test_seeds_differ_between_worlds_and_episodes(varied):
    env = make_race_vector(40, **{**varied, "num_cars": 1})
    poses, vehicles, tracks = [], [], []
    for _ in range(5):
        observation, info = env.reset(seed=1) if not poses else env.reset()
        poses.append(observation["pose"])
        vehicles.append(info["vehicle"][:, 0, 0])
        tracks.append(info["track"])
    assert len(np.unique(np.concatenate(poses)[:, :2], axis=0)) == 200
    assert len(np.unique(np.concatenate(vehicles))) == 200
    for episode in tracks:
        assert len(set(episode)) == 3
    for world in zip(*tracks, strict=True):
        assert len(world) == 5
    assert np.mean([len(set(world)) > 1 for world in zip(*tracks, strict=True)]) > 0.9


def test_without_a_seed_the_streams_go_on(varied):
    """A seed starts them anew; no seed draws the next episodes, as autoreset does."""
    env = make_race_vector(3, **varied)
    first, second = env.reset(seed=9)[0], env.reset()[0]
    assert not np.array_equal(first["pose"], second["pose"])
    assert_equal(env.reset(seed=9)[0], first, "the seed again")
    assert_equal(env.reset()[0], second, "and no seed again")


def test_unseeded_environments_differ(varied):
    a, b = (make_race_vector(2, **varied).reset()[0]["pose"] for _ in range(2))
    assert not np.array_equal(a, b)
    assert not np.array_equal(a[0], a[1])


def test_a_list_seeds_world_by_world(varied):
    env = make_race_vector(3, **varied)
    ranged = env.reset(seed=20)[0]["pose"]
    np.testing.assert_array_equal(env.reset(seed=[20, 21, 22])[0]["pose"], ranged)
    np.testing.assert_array_equal(env.reset(seed=[22, 20, 21])[0]["pose"], ranged[[2, 0, 1]])
    np.testing.assert_array_equal(env.reset(seed=[7, 7, 7])[0]["pose"][1:], env.reset(seed=[7, 7, 7])[0]["pose"][:2])
    env.reset(seed=20)
    going_on = env.reset()[0]["pose"][1]
    env.reset(seed=20)
    mixed = env.reset(seed=[22, None, 20])[0]["pose"]
    np.testing.assert_array_equal(mixed[[0, 2]], ranged[[2, 0]])
    np.testing.assert_array_equal(mixed[1], going_on)


def test_a_world_whose_first_seed_is_none_is_random(varied):
    a, b = (make_race_vector(3, **varied).reset(seed=[1, None, None])[0]["pose"] for _ in range(2))
    np.testing.assert_array_equal(a[0], b[0])
    assert not np.array_equal(a[1], a[2])
    assert not np.array_equal(a[1], b[1])


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, 4], -1, [0, -3, 1], "seven", [0, 1.5, 2]])
def test_wrong_seeds_are_refused(ellipse, seed):
    env = make_race_vector(3, tracks=[ellipse], beams=0)
    with pytest.raises(OutlapError, match="seed"):
        env.reset(seed=seed)


def test_without_autoreset_the_caller_resets_by_mask(varied):
    env = make_race_vector(3, autoreset_mode="Disabled", **{**varied, "num_cars": 1})
    assert env.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    assert make_race_vector(1, **varied).metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    env.reset(seed=0)
    over = np.zeros(3, bool)
    while not over.any():
        observation, _, terminated, truncated, info = env.step(np.tile([0.8, -0.2], (3, 1)))
        over = terminated | truncated
    assert "final_obs" not in info
    assert (info["outcome"][over] != "").all()
    with pytest.raises(OutlapError, match="reset"):
        env.step(np.zeros((3, 2)))
    after, info = env.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(info["time_s"] == 0.0, over)
    np.testing.assert_array_equal(after["pose"][~over], observation["pose"][~over])
    np.testing.assert_array_equal((after["pose"] != observation["pose"]).any(axis=1), over)
    env.step(np.zeros((3, 2)))


@pytest.mark.parametrize("mask", [np.ones(2, bool), np.ones(4, bool), np.ones((3, 1), bool)])
def test_a_mask_of_a_wrong_shape_is_refused(ellipse, mask):
    env = make_race_vector(3, tracks=[ellipse], beams=0)
    with pytest.raises(OutlapError, match="reset_mask"):
        env.reset(options={"reset_mask": mask})


def test_stepping_before_a_reset_is_refused(ellipse):
    with pytest.raises(OutlapError, match="reset"):
        make_race_vector(2, tracks=[ellipse], beams=0).step(np.zeros((2, 2)))
    env = make_race_vector(2, tracks=[ellipse], beams=0)
    env.reset(seed=0, options={"reset_mask": np.array([True, False])})
    with pytest.raises(OutlapError, match=r"world 1.*reset"):
        env.step(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros(2), "shape"),
        (np.zeros((3, 2)), "shape"),
        (np.zeros((2, 3)), "shape"),
        ([[0.0, 0.0], [np.nan, 0.0]], "finite .row 1"),
        ([[0.0, np.inf], [0.0, 0.0]], "finite .row 0"),
        ([["left", 0.0], [0.0, 0.0]], "given .*left.*numbers"),
        (None, "given None; must be numbers"),
    ],
)
def test_wrong_actions_are_refused_and_change_nothing(ellipse, actions, words):
    env = make_race_vector(2, tracks=[ellipse], beams=4)
    env.reset(seed=0)
    before = env.race.worlds.state.copy()
    with pytest.raises(OutlapError, match=words) as caught:
        env.step(actions)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(env.race.worlds.state, before)
    assert (env.race.worlds.time == 0.0).all()
    env.step(np.zeros((2, 2)))  # and it goes on
