"""Any car, any task, any action: what an environment tells stays finite and within what it declares."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from any_worlds import FIELDS, campaign, car_config, circuits, oddities, shares, value_at
from outlap.envs.keywords import make_parallel, make_race, make_race_vector, make_sb3
from outlap.envs.observations import OBSERVATION_TERMS
from outlap.envs.rewards import REWARD_PRESETS, REWARD_TERMS
from outlap.errors import OutlapError
from outlap.planning.path import path_along
from outlap.simulator.simulator import MODELS
from outlap.simulator.state import X, Y

WORLDS = 3
numbers = st.floats(-1.5, 1.5) | st.sampled_from([-1.0, 0.0, 1.0, 1e300, -1e300])


@st.composite
def cars(draw: st.DrawFn) -> dict[str, Any]:
    """Ranges within what is accepted, from which every car is drawn anew."""
    odd: dict[tuple[str, str], Any] = {field: value_at(*field, share) for field, share in draw(oddities).items()}
    for field, share in draw(st.dictionaries(st.sampled_from(FIELDS), shares, max_size=3)).items():
        odd[field] = sorted((odd.get(field, value_at(*field, 0.5)), value_at(*field, share)))
    for size in ("length", "width"):  # with which there is a start
        if ("vehicle", size) in odd:
            odd["vehicle", size] = np.clip(odd["vehicle", size], 0.01, 0.6).tolist()
    return car_config(odd)


@st.composite
def races(draw: st.DrawFn) -> dict[str, Any]:
    """The keywords of an environment."""
    terms = draw(st.sets(st.sampled_from([*OBSERVATION_TERMS]), min_size=1) | st.just({*OBSERVATION_TERMS}))
    preset = draw(st.sampled_from([*REWARD_PRESETS]))
    weights = draw(st.sampled_from([{}, dict.fromkeys(REWARD_TERMS, 1.0)]))
    return {
        **draw(cars()),
        "tracks": draw(st.sets(st.integers(0, 5), min_size=1, max_size=3)),
        "num_cars": draw(st.integers(1, 4)),
        "opponents": draw(st.sampled_from(["pure-pursuit", "follow-the-gap"])),
        "opponent_crash": draw(st.sampled_from(["park", "remove", "respawn"])),
        "opponent_speed": draw(st.none() | st.floats(0.0, 10.0) | st.just(0.0)),
        "opponent_noise": draw(st.sampled_from([0.0, 1.0])),
        "observation": sorted(terms),
        "scale_observations": draw(st.booleans()),
        "nearby_cars": draw(st.integers(1, 4)),
        "reward": {"preset": preset, "weights": weights},
        "model": draw(st.sampled_from([*MODELS])),
        "control_interval": draw(st.integers(1, 5)),
        "beams": draw(st.sampled_from([9, 17])),
        "speed_range": draw(st.sampled_from([None, (0.0, None), (0.0, 3.0)])),
        "start": {"formation": draw(st.sampled_from(["queue", "behind", "grid", "scattered"])), "speed": (-3.0, 5.0)},
        "termination": {"time_limit": 0.4, "stall_time": 0.2, "laps": draw(st.integers(0, 1))},
    }


@pytest.fixture
def lines_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planned lines are tested elsewhere, and take seconds: here every car is to race the centreline."""
    monkeypatch.setattr(
        "outlap.envs.racing_line.cached_line",
        lambda track, *_: SimpleNamespace(path=path_along(track.centerline, 0.5)),
    )


def test_what_is_told_is_finite_within_the_spaces_and_ends_by_the_rules(lines_at_once):
    @campaign
    @given(races(), st.integers(0, 2**32), st.lists(st.tuples(numbers, numbers), min_size=1, max_size=12))
    def race(config: dict[str, Any], seed: int, actions: list[tuple[float, float]]) -> None:
        tracks = [circuits()[number] for number in config["tracks"]]
        env = make_race_vector(WORLDS, **{**config, "tracks": tracks})
        try:
            env.reset(seed=seed)
        except OutlapError as error:
            if "found no start free of contact" not in str(error):
                raise
            event("no room for a start")
            return
        space, worlds, over = env.single_observation_space, env.race.worlds, 0
        limit = math.ceil(0.4 / (0.01 * config["control_interval"]) - 1e-6)
        for action in actions:
            for _ in range(3):
                observation, rewards, terminated, truncated, info = env.step(np.tile(action, (WORLDS, 1)))
                ended = terminated | truncated
                over += ended.sum()
                for world in range(WORLDS):
                    now = {name: value[world] for name, value in observation.items()}
                    assert space.contains(now)
                    _all_finite(now)
                    track = env.race.simulator.tracks[worlds.track[world]]
                    assert not track.is_wall(*worlds.state[world][:, [X, Y]].astype(float).T).any()
                    if not ended[world]:
                        continue
                    _all_finite(info["final_obs"][world])
                    assert space.contains(info["final_obs"][world])
                    final = {name: value[world] for name, value in info["final_info"].items()}
                    assert (final["outcome"] == "crash") == terminated[world] == (final["contact"] != "")
                    assert final["outcome"] in ("crash", "finished", "timeout", "stalled")
                    assert final["episode_steps"] <= limit
                    assert np.isfinite([final["episode_return"], final["progress_m"], final["impact_speed_mps"]]).all()
                assert np.isfinite(rewards).all()
                assert not (terminated & truncated).any()
                assert (worlds.time < 0.4 - 1e-9).all()
        event(f"episodes ended: {min(over, 5)}")

    race()


def _all_finite(observation: dict[str, np.ndarray]) -> None:
    for name, value in observation.items():
        assert np.isfinite(value).all(), name


NONSENSE = [
    [0.0, math.nan], [math.inf, 0.0], [0.0, -math.inf], [0.0], [0.0, 0.0, 0.0], 0.0, None, "left", ["0.1", "left"],
    [[0.0], [0.0, 1.0]], {"steer": 0.0}, [None, 0.0], np.array([0.0, 1j]), np.array(["a", "b"], object),
]  # fmt: skip


@pytest.mark.parametrize("action", NONSENSE, ids=[f"{each!r:.24}" for each in NONSENSE])
def test_an_action_that_is_none_is_refused_by_every_environment_and_changes_nothing(circle, action):
    config = {"tracks": [circle], "beams": 3}
    many, one, stable = make_race_vector(1, **config), make_race(**config), make_sb3(1, **config)
    agents = make_parallel(2, **config)
    for env in (many, one, agents):
        env.reset(seed=0)
    stable.reset()
    ok, batch = np.zeros(2), cast(np.ndarray, [action])
    for step, race in (
        (lambda: many.step(batch), many), (lambda: one.step(action), one._env),
        (lambda: stable.step(batch), stable.env),
        (lambda: agents.step({"car_0": ok, "car_1": action}), agents._env),
    ):  # fmt: skip
        before = race.race.worlds.state.copy()
        with pytest.raises(OutlapError) as caught:
            step()
        assert "\n" not in str(caught.value)
        np.testing.assert_array_equal(race.race.worlds.state, before)
        assert race.race.worlds.tick[0] == 0


@pytest.mark.parametrize("action", [[1e300, -1e300], [2, -7], np.array([1e10, -1e10], np.float32), [True, -1.0]])
def test_an_action_however_large_is_clipped_by_every_environment(circle, action):
    config = {"tracks": [circle], "beams": 0, "observation": ["previous_action"]}
    many, one, stable, agents = (
        make_race_vector(1, **config), make_race(**config), make_sb3(1, **config), make_parallel(2, **config)
    )  # fmt: skip
    for env in (many, one, stable, agents):
        env.reset()
    batch = cast(np.ndarray, [action])
    told = [
        many.step(batch)[0]["previous_action"][0], one.step(action)[0]["previous_action"],
        cast(dict, stable.step(batch)[0])["previous_action"][0],
        agents.step({"car_0": action, "car_1": action})[0]["car_1"]["previous_action"],
    ]  # fmt: skip
    np.testing.assert_array_equal(told, [[1.0, -1.0]] * 4)
