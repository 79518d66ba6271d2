"""Every reward term against a hand calculation, the curricula, the presets, and the sum."""

from __future__ import annotations

import math

import numpy as np
import pytest

from outlap.envs.keywords import make_race_vector
from outlap.envs.rewards import REWARD_PRESETS, REWARD_TERMS, RewardConfig, curriculum_scales
from outlap.errors import OutlapError
from outlap.planning.limits import CarLimits
from outlap.planning.line_cache import cached_line
from outlap.planning.plan import DEFAULT_MARGIN
from outlap.simulator.atlas import FIRST_ROW, ROWS
from outlap.track.generate import generate_track

STANDSTILL = -0.6  # the speed action that stands for 0 m/s between -5 and 20


def only(**weights: float) -> dict:
    """A reward of these terms and no others."""
    return {"weights": {**dict.fromkeys(REWARD_TERMS, 0.0), **weights}}


def test_the_reward_is_the_sum_of_what_the_info_logs(ellipse, follow):
    """With every term on, through resets: each logged total grows by what the reward grew."""
    weights = {name: 0.5 + 0.25 * i for i, name in enumerate(REWARD_TERMS)}
    env = make_race_vector(
        4, tracks=[ellipse], num_cars=2, beams=0, reward={"weights": weights}, start={"speed": 3.0}, opponent_speed=1.0,
        control_interval=3, termination={"time_limit": 2.5, "stall_time": 1.0},
    )  # fmt: skip
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    before = {name: np.zeros(4) for name in REWARD_TERMS}
    used, episodes = dict.fromkeys(REWARD_TERMS, 0.0), 0
    for _ in range(250):
        actions = np.clip(follow(env, -0.3, 0.6) + rng.normal(0.0, 0.1, (4, 2)), -1.0, 1.0)
        actions[2, 0], actions[3, 1] = 1.0, STANDSTILL  # one into the wall, one nowhere
        _, rewards, terminated, truncated, info = env.step(actions)
        over = terminated | truncated
        logged = np.zeros(4)
        for name in REWARD_TERMS:
            total = info[f"reward_{name}"]
            ended = np.where(over, info["final_info"][f"reward_{name}"], total) if over.any() else total
            used[name] += np.abs(ended - before[name]).sum()
            logged += ended - before[name]
            before[name] = np.where(over, 0.0, total)
        np.testing.assert_allclose(rewards, logged, atol=1e-9)
        if over.any():
            final = info["final_info"]
            np.testing.assert_allclose(
                final["episode_return"], sum(final[f"reward_{name}"] for name in REWARD_TERMS), rtol=1e-9
            )
            episodes += over.sum()
    assert episodes > 3
    del used["overtaken"]  # nobody here is faster than the ego; see test_race
    assert min(used.values()) > 0.0, f"a term never counted: {used}"


def test_a_term_counts_with_its_weight(ellipse):
    """Twice the weight, twice the reward; no weight, no entry in the info."""
    rewards = []
    for weight in (1.0, 2.0):
        env = make_race_vector(2, tracks=[ellipse], beams=0, reward=only(progress=weight))
        env.reset(seed=0)
        rewards.append([env.step(np.tile([0.0, 0.0], (2, 1)))[1] for _ in range(10)])
        info = env.step(np.zeros((2, 2)))[-1]
        assert [name for name in info if name.startswith("reward_")] == ["reward_progress"]
    np.testing.assert_allclose(rewards[1], 2.0 * np.array(rewards[0]))
    assert np.abs(rewards[0]).min() > 0.0


def test_progress_is_metres_and_lap_progress_laps_along_the_line(circle, put, follow):
    """Over the start line too: two laps of 2 pi 4 m, measured by the angle of the car's position."""
    metres, laps = (
        make_race_vector(
            1, tracks=[circle], beams=0, observation="pose", reward=only(**{term: 1.0}), control_interval=5
        )
        for term in ("progress", "lap_progress")
    )
    put(metres, [1.0, 0.2, 0.0, 3.0])
    put(laps, [1.0, 0.2, 0.0, 3.0])
    angle = 1.0 / 4.0
    for _ in range(350):
        action = follow(metres, -0.28)
        observation, reward, terminated, _, _ = metres.step(action)
        _, share, _, _, _ = laps.step(action)
        assert not terminated.any()
        x, y, _ = observation["pose"][0].astype(float)
        turn = math.remainder(math.atan2(y, x) - angle, 2.0 * math.pi)
        angle += turn
        assert reward[0] == pytest.approx(4.0 * turn, abs=1e-4)
        assert share[0] == pytest.approx(turn / (2.0 * math.pi), abs=1e-5)
    assert angle > 4.5 * math.pi, "the test needs more than two laps"


def test_progress_backwards_is_negative(circle, put):
    env = make_race_vector(1, tracks=[circle], beams=0, reward=only(progress=1.0))
    put(env, [0.3, 0.0, 0.0, -2.0])
    total = sum(env.step(np.array([[0.196, -0.76]]))[1][0] for _ in range(30))
    assert total == pytest.approx(-0.6, abs=0.05)


def test_milestones_count_once_and_not_again_after_reversing(circle, put):
    """Five a lap: one each 5.03 m from the start, wherever that is. Forward, back over it, forward again."""
    env = make_race_vector(
        1, tracks=[circle], beams=0, reward={**only(milestone=1.0), "milestones": 5}, termination={"stall_time": 0.0}
    )
    length = circle.centerline.length
    put(env, [length - 4.0, 0.0, 0.0, 2.0])
    counts = []
    for speed_action, there in ((-0.48, 5.5), (-0.72, 4.5), (-0.48, 5.5), (-0.48, 10.5)):
        count, progress = 0.0, env.race.distance[0, 0] - env.race.start[0, 0]
        while (progress - there) * (speed_action - STANDSTILL) < 0.0:
            _, reward, terminated, truncated, info = env.step(np.array([[0.196, speed_action]]))
            assert not (terminated | truncated).any()
            progress = info["progress_m"][0]
            count += reward[0]
        counts.append(count)
    assert counts == [1.0, 0.0, 0.0, 1.0]


def test_all_milestones_of_a_lap_are_counted(circle, put, follow):
    """Ten by default, with the wrap at the start line; each is worth the preset's 5."""
    env = make_race_vector(1, tracks=[circle], beams=0, reward="paper", control_interval=10)
    put(env, [13.0, 0.0, 0.0, 5.0])
    hits = []
    for _ in range(1000):
        *_, info = env.step(follow(env, -0.24))
        hits.append(info["reward_milestone"][0])
        assert hits[-1] == 5.0 * math.floor(info["progress_m"][0] / (0.1 * circle.centerline.length))
        if info["progress_m"][0] > 1.5 * circle.centerline.length:
            break
    assert hits[-1] == 75.0
    assert set(np.diff(hits)) == {0.0, 5.0}


@pytest.mark.parametrize("progress", [0.0, 0.1, 0.5, 1.0])
def test_the_collision_penalty_grows_from_its_minimum_to_its_maximum(ellipse, put, progress):
    """-(a + (b - a) tanh(p / T) / tanh(1 / T)), at the step of the crash; `previous_reward` shows the last one."""
    reward = {**only(collision=0.5), "collision_min": 2.0, "collision_max": 5.0, "collision_growth": 0.4}
    env = make_race_vector(2, tracks=[ellipse], beams=0, reward=reward, observation="previous_reward")
    put(env, np.array([[[0.0, 0.0, 1.3, 5.0]], [[0.0, 0.0, 0.0, 0.0]]]))
    env.training_progress = progress
    for _ in range(100):
        _, rewards, terminated, _, info = env.step(np.array([[0.0, -0.2], [0.0, STANDSTILL]]))
        assert info["training_progress"].tolist() == [progress] * 2
        assert rewards[1] == 0.0
        if terminated[0]:
            break
        assert rewards[0] == 0.0
    assert terminated[0]
    expected = -0.5 * (2.0 + 3.0 * math.tanh(progress / 0.4) / math.tanh(1.0 / 0.4))
    assert rewards[0] == pytest.approx(expected, rel=1e-12)
    assert info["final_obs"][0]["previous_reward"] == pytest.approx(-2.5, rel=1e-6)


def test_the_papers_penalty_is_the_papers_at_the_papers_length():
    """SYSTEM §2: 1 + (c_max - 1) tanh(t / 1e5), and a sigmoid in (t - 1e6) / 1e5, in trainings of 3e6 steps."""
    config = RewardConfig(preset="paper", collision_max=7.0)
    for steps in (0, 5e4, 1e5, 9e5, 1e6, 1.2e6, 3e6):
        penalty, weight = curriculum_scales(steps / 3e6, config)
        assert penalty == pytest.approx(1.0 + 6.0 * math.tanh(steps / 1e5), rel=1e-12)
        assert weight == pytest.approx(1.0 / (1.0 + math.exp((steps - 1e6) / 1e5)), rel=1e-6)


def test_a_stall_costs_one_where_it_ends_the_episode(ellipse, put):
    """And nothing before; a timeout is no stall."""
    for limits, expected in (({"stall_time": 0.05}, -1.0), ({"time_limit": 0.05}, 0.0)):
        env = make_race_vector(1, tracks=[ellipse], beams=0, reward=only(stall=1.0), termination=limits)
        put(env, [0.0, 0.0, 0.0, 0.0])
        for step in range(10):
            _, rewards, _, truncated, _ = env.step(np.array([[0.0, STANDSTILL]]))
            assert truncated[0] == (step in (4, 9))
            assert rewards[0] == (expected if truncated[0] else 0.0)


def test_curricula_stand_at_their_end_outside_of_a_training(ellipse):
    env = make_race_vector(3, tracks=[ellipse], beams=0)
    _, info = env.reset(seed=0)
    assert info["training_progress"].tolist() == [1.0] * 3
    np.testing.assert_allclose(env.curriculum_scales, [10.0, 0.0], atol=1e-8)
    env.training_progress = 0.25
    env.step(np.zeros((3, 2)))
    env.reset()
    assert env.training_progress == 0.25, "neither a step nor a reset moves a curriculum"


@pytest.mark.parametrize("wrong", [-0.1, 1.5, 2e6, math.nan])
def test_a_progress_that_is_no_share_is_refused(ellipse, wrong):
    env = make_race_vector(1, tracks=[ellipse], beams=0)
    with pytest.raises(OutlapError, match=r"training_progress is .* the share of training done, 0 to 1"):
        env.training_progress = wrong


@pytest.mark.parametrize("progress", [0.0, 0.3, 1 / 3, 0.4, 1.0])
def test_the_velocity_penalty_fades_over_training(big_circle, put, progress):
    """-(v - v_ref)² / (1 + exp((p - 1/3) / (1/30))), v_ref = sqrt(mu g r) on the inside, the shortest way around."""
    env = make_race_vector(1, tracks=[big_circle], beams=0, reward=only(velocity_matching=1.0))
    put(env, [2.0, 0.0, 0.0, 3.0])
    half_width = float(big_circle.centerline.width_left[0])
    reference = math.sqrt(1.0489 * 9.81 * (8.0 - half_width + 0.155 + DEFAULT_MARGIN))
    env.training_progress = progress
    for _ in range(20):
        _, rewards, _, _, _ = env.step(np.array([[0.1, 0.0]]))
        speed = float(env.race.worlds.state[0, 0, 3])
        expected = -((speed - reference) ** 2) / (1.0 + math.exp((progress - 1 / 3) * 30))
        assert rewards[0] == pytest.approx(expected, rel=0.02)


def test_the_reference_speed_is_that_of_the_very_car(big_circle):
    """Friction is drawn for every world: on a circle the square of the speed is in proportion to it."""
    env = make_race_vector(
        6, tracks=[big_circle], beams=0, reward=only(velocity_matching=1.0), vehicle={"mu": (0.4, 0.9)}
    )
    env.reset(seed=0)
    race = env.race
    assert race.reference is not None
    speeds = race.reference.at(0, race.worlds.track, race.line_rows(0, np.zeros(1))[:, 0])
    mu = race.worlds.params["mu"][:, 0]
    np.testing.assert_allclose(speeds**2 / mu, (speeds**2 / mu)[0], rtol=2e-2)
    assert mu.max() - mu.min() > 0.2


def test_the_reference_is_that_of_the_place_and_of_the_track():
    """Two circuits in one environment: everywhere on either, the speed of the line's nearest point."""
    tracks = [generate_track(seed, length=60.0, name=f"track{seed}") for seed in (1, 2)]
    env = make_race_vector(8, tracks=tracks, beams=0, reward=only(velocity_matching=1.0), vehicle={"v_max": 8.0})
    env.reset(seed=1)
    race, seen = env.race, set()
    assert race.reference is not None
    atlas = race.simulator.atlas
    for world, number in enumerate(race.worlds.track.tolist()):
        track, (first, rows) = tracks[number], atlas.index[number, [FIRST_ROW, ROWS]]
        line = cached_line(track, CarLimits.of_record(race.worlds.params[world, 0], "single_track"))
        at, _ = track.centerline.to_frenet(*line.path.points.T)
        for row in range(0, rows, 40):
            everyone = np.full(8, atlas.index[race.worlds.track, FIRST_ROW])
            everyone[world] = first + row
            away = np.abs((at - row * track.centerline.length / rows + 5.0) % track.centerline.length - 5.0)
            expected = line.speed[away.argmin()]
            assert race.reference.at(0, race.worlds.track, everyone)[world] == pytest.approx(expected, rel=0.03)
            seen.add(round(float(expected), 1))
    assert len(seen) > 5, "the test needs fast and slow places"
    assert set(race.worlds.track.tolist()) == {0, 1}


def test_the_reference_speed_is_no_more_than_the_car_can_drive(big_circle, put):
    """Cornering would allow 8.1 m/s; this car does 4, and one that drives 4 is not blamed."""
    env = make_race_vector(1, tracks=[big_circle], beams=0, reward=only(velocity_matching=1.0), vehicle={"v_max": 4.0})
    put(env, [2.0, 0.0, 0.0, 4.0])
    assert env.step(np.array([[0.1, 1.0]]))[1][0] == pytest.approx(0.0, abs=1e-4)


def test_changes_of_the_action_cost_their_size(ellipse):
    """The first change counts from zero; only the ego's own actions count, after clipping."""
    steering, speed = (
        make_race_vector(1, tracks=[ellipse], num_cars=2, beams=0, reward=only(**{term: 1.0}))
        for term in ("steering_change", "speed_change")
    )
    actions = [[0.3, -0.5], [0.3, -0.5], [-0.2, -0.1], [9.0, -0.1], [1.0, -0.6]]
    costs = []
    for env in (steering, speed):
        env.reset(seed=0)
        costs.append([env.step(np.array([action]))[1][0] for action in actions])
    np.testing.assert_allclose(costs[0], [-0.3, 0.0, -0.5, -1.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(costs[1], [-0.5, 0.0, -0.4, 0.0, -0.5], atol=1e-6)


def test_after_a_reset_the_change_counts_from_zero_again(ellipse):
    env = make_race_vector(
        1, tracks=[ellipse], beams=0, reward=only(speed_change=1.0), termination={"time_limit": 0.02}
    )
    env.reset(seed=0)
    costs = [env.step(np.array([[0.0, -0.4]]))[1][0] for _ in range(6)]
    np.testing.assert_allclose(costs, [-0.4, 0.0] * 3, atol=1e-6)


def test_the_papers_preset():
    """SYSTEM §2: weights of the authors' configuration; a collision penalty that does grow."""
    config = RewardConfig(preset="paper")
    assert config.resolved() == {
        "milestone": 5.0, "lap_progress": 100.0, "collision": 1.0, "velocity_matching": 10.0,
        "steering_change": 0.05, "overtake": 20.0,
        "overtaken": 20.0,
    }  # fmt: skip
    assert config.milestones == 10
    assert config.collision_max > config.collision_min


def test_the_fast_preset_is_the_default(ellipse):
    env = make_race_vector(1, tracks=[ellipse], beams=0)
    assert env.config.reward.preset == "fast"
    assert env.config.reward.resolved() == REWARD_PRESETS["fast"]
    assert {"progress", "collision", "steering_change"} <= set(REWARD_PRESETS["fast"])


def test_weights_replace_the_presets(ellipse):
    reward = {"preset": "paper", "weights": {"milestone": 0, "overtake": 7}}
    env = make_race_vector(1, tracks=[ellipse], beams=0, reward=reward)
    _, info = env.reset(seed=0)
    assert env.config.reward.resolved() == {
        "lap_progress": 100.0, "collision": 1.0, "velocity_matching": 10.0, "steering_change": 0.05, "overtake": 7.0,
        "overtaken": 20.0,
    }  # fmt: skip
    assert "reward_milestone" not in info
    assert "reward_overtake" in info


def test_every_preset_names_terms_that_exist():
    assert all(set(weights) <= set(REWARD_TERMS) for weights in REWARD_PRESETS.values())


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        ({"weights": {"speeding": 1.0}}, "weights.*'speeding'.*milestone, progress"),
        ("slow", "preset.*'slow'.*'fast' or 'paper'"),
        ({"preset": "papre"}, "preset.*'papre'"),
        ({"weight": {"progress": 1.0}}, "weight is not a known field"),
        ({"weights": {"progress": "much"}}, "weights.progress"),
        ({"milestones": 0}, "milestones is 0"),
        ({"collision_max": 0.5}, "collision_max is 0.5; must be at least collision_min, 1"),
        ({"collision_growth": 0}, "collision_growth is 0"),
        ({"collision_growth": 1e5}, "collision_growth is 100000"),
        ({"collision_steps": 1e5}, "collision_steps counts.*collision_growth = collision_steps / total_steps"),
        ({"velocity_step": 1e6}, "velocity_step counts.*velocity_fade = velocity_step / total_steps"),
        ({"velocity_width": 1e5}, "velocity_width counts.*velocity_fade_width = velocity_width / total_steps"),
        (3, "reward is 3"),
    ],
)
def test_wrong_rewards_are_refused(ellipse, reward, words):
    with pytest.raises(OutlapError, match=f"reward.*{words}|{words}") as caught:
        make_race_vector(1, tracks=[ellipse], beams=0, reward=reward)
    assert "\n" not in str(caught.value)
    assert "reward" in str(caught.value)


def test_rewards_and_results_are_of_the_true_motion(ellipse):
    """Sensors that are wrong in every way change what is observed, and neither the reward nor what is counted."""
    wrong = {"speed_scale": 1.5, "speed_noise": 0.5, "yaw_rate_bias": 1.0, "yaw_rate_noise": 0.5}
    races = [
        make_race_vector(
            4, tracks=[ellipse], beams=0, control_interval=5, observation="vel", sensors=sensors, odometry=odometry,
            reward={"weights": {"progress": 1.0, "stall": 1.0, "steering_change": 0.1, "speed_change": 0.1}},
        )
        for sensors, odometry in (({}, "full"), (wrong, "vesc"))
    ]  # fmt: skip
    for env in races:
        env.reset(seed=3)
    for step in range(20):
        action = np.tile([0.1, -0.4 + 0.02 * step], (4, 1))
        (seen, reward, *_, info), (seen_wrongly, same_reward, *_, same_info) = (env.step(action) for env in races)
        np.testing.assert_array_equal(reward, same_reward)
        for name in ("progress_m", "mean_speed_mps", "episode_return"):
            np.testing.assert_array_equal(info[name], same_info[name])
    assert np.abs(seen["vel"] - seen_wrongly["vel"]).max() > 0.3
