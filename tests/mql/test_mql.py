"""MQL as an algorithm: it learns, adapts, repeats, is saved and read back, and acts as it was trained."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from outlap.errors import OutlapError
from outlap.mql.adaptation import adapt, features
from outlap.mql.config import AdaptationConfig
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.mql import MQL
from outlap.mql.propensity import AdaptiveBetaClip, FixedClip, NoClip, fit_propensity
from toy_tasks import HiddenGoal

TOY: dict[str, Any] = {
    "learning_rate": 1e-3, "learning_starts": 1000, "batch_size": 128, "buffer_size": 20_000, "gamma": 0.9,
    "gradient_steps": 4, "device": "cpu", "seed": 0,
}  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def toy(env: Any = None, steps: int = 0, **policy_kwargs: Any) -> MQL:
    model = MQL(env=env or HiddenGoal(16, -1.0, 1.0), policy_kwargs={"preset": "fast", **policy_kwargs}, **TOY)
    return model.learn(steps) if steps else model


@pytest.fixture(scope="module")
def meta() -> MQL:
    torch.set_num_threads(1)
    return toy(steps=7000)


def mean_return(policy: Any, low: float, high: float) -> float:
    env = ContextVecEnv(HiddenGoal(64, low, high, seed=5))
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=128, warn=False)
    return float(np.mean(mean))


def weights(model: MQL) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


def test_tasks_are_told_through_wrappers() -> None:
    model = toy(VecMonitor(HiddenGoal(16, -1.0, 1.0)), steps=64)
    assert len(model.replay_buffer.tasks) > 1
    assert all(str(task).startswith("goal ") for task in model.replay_buffer.tasks)


def test_an_environment_that_shows_no_reward_is_named(meta: MQL) -> None:
    with pytest.raises(OutlapError, match=r"is not shown 'previous_reward'; put its environment into a ContextVecEnv"):
        evaluate_policy(meta, HiddenGoal(4, -1.0, 1.0), n_eval_episodes=4, warn=False)


def test_context_finds_a_goal_that_nothing_else_tells(meta: MQL) -> None:
    # Best without knowing: stay at 0, -0.5 a step. Straight to the goal: about -1.3 in all.
    deaf = toy(steps=7000, uses_context=False)
    assert mean_return(meta, -1.0, 1.0) > -5.0
    assert mean_return(deaf, -1.0, 1.0) < -8.0


def test_adapting_improves_a_goal_further_out_than_any_before(meta: MQL) -> None:
    before, replay = weights(meta), meta.replay_buffer.added
    optimizer = copy.deepcopy(meta.policy.critic_optimizer.state_dict())
    settings = AdaptationConfig(
        iterations=4, collect_steps=40, on_task_steps=20, replay_steps=20, batch_size=128, learning_rate=1e-3,
        clip=FixedClip(),
    )  # fmt: skip
    adapted, record = adapt(meta, HiddenGoal(8, 1.4, 1.4, seed=3), settings)
    assert mean_return(adapted, 1.4, 1.4) > mean_return(meta, 1.4, 1.4) + 2.0
    # The meta-policy is as it was, bit for bit.
    assert all(torch.equal(now, then) for now, then in zip(weights(meta), before, strict=True))
    assert meta.replay_buffer.added == replay
    state = meta.policy.critic_optimizer.state_dict()["state"]
    assert all(torch.equal(state[i]["exp_avg"], optimizer["state"][i]["exp_avg"]) for i in state)
    assert [row["task_transitions"] for row in record.iterations] == [320, 640, 960, 1280]
    assert len(record.updates) == 80
    for row in record.updates:
        assert row["clipped_beta_max"] <= row["clip_level"] == pytest.approx(np.exp(1.5))
        assert row["proximal_weight"] == 1.0 - row["effective_sample_size"]


def test_a_task_like_all_others_weighs_its_replay_evenly(meta: MQL) -> None:
    settings = AdaptationConfig(iterations=1, on_task_steps=0, replay_steps=5, clip=NoClip())
    _, record = adapt(meta, meta.replay_buffer, settings)
    row = record.iterations[0]
    assert row["classifier_accuracy"] == pytest.approx(0.5, abs=0.1)
    assert row["effective_sample_size"] > 0.9
    assert row["proximal_weight"] < 0.1


def test_adaptive_clipping_starts_afresh_with_every_adaptation(meta: MQL) -> None:
    settings = AdaptationConfig(
        iterations=1, collect_steps=20, on_task_steps=0, replay_steps=3, clip=AdaptiveBetaClip()
    )
    first, second = (adapt(meta, HiddenGoal(8, 1.4, 1.4, seed=3), settings)[1].updates for _ in range(2))
    assert [row["clip_level"] for row in first] == [row["clip_level"] for row in second]


def test_adapting_needs_the_replay_of_the_meta_training(meta: MQL) -> None:
    with pytest.raises(OutlapError, match="has no replay; load it"):
        adapt(toy(), HiddenGoal(8, 1.4, 1.4))


def test_a_seeded_run_repeats_exactly() -> None:
    first, second = toy(steps=1600), toy(steps=1600)
    assert first._n_updates > 50
    assert all(torch.equal(a, b) for a, b in zip(weights(first), weights(second), strict=True))


def test_it_acts_on_the_windows_that_it_is_trained_on(meta: MQL) -> None:
    buffer = meta.replay_buffer
    start = np.array(
        [serial for serial in range(buffer.oldest, buffer.added) if buffer.before[serial % buffer.capacity] < 0]
    )
    serial, state = start[len(start) // 2], None
    for step in range(15):  # an episode as it was stored, seen through predict
        row = serial % buffer.capacity
        observation = {name: column[row][None] for name, column in buffer.observation.items()}
        if state is not None:
            state.action[:] = buffer.action[row]  # what was done, noise and all
        chosen, state = meta.policy.predict(observation, state)
        windows = buffer.windows(np.array([serial]), meta.policy.history, meta.policy.window_terms)
        np.testing.assert_allclose(chosen, meta.policy.act(observation, windows), atol=1e-6)
        assert windows.valid.sum() == min(step + 1, meta.policy.history)
        serial = buffer.after[row]


def test_a_new_episode_forgets_the_one_before(meta: MQL) -> None:
    def seen(place: float) -> dict[str, np.ndarray]:
        return {
            "observation": np.full((2, 1), place, np.float32),
            "previous_reward": np.full((2, 1), -place, np.float32),
        }

    state = None
    for place in (0.3, 0.6, 0.9):
        _, state = meta.predict(seen(place), state, np.zeros(2, bool))
    again, _ = meta.predict(seen(0.2), state, np.array([True, False]))
    fresh, _ = meta.predict(seen(0.2))
    np.testing.assert_allclose(again[0], fresh[0], atol=1e-6)
    assert abs(again[1] - fresh[1]).max() > 1e-3


def test_a_saved_model_and_its_replay_go_on(meta: MQL, tmp_path: Path) -> None:
    meta.save(tmp_path / "model.zip")
    meta.save_replay_buffer(tmp_path / "replay.npz")
    loaded = MQL.load(tmp_path / "model.zip", env=HiddenGoal(8, -1.0, 1.0), device="cpu")  # fewer worlds than before
    loaded.load_replay_buffer(tmp_path / "replay.npz")
    assert all(torch.equal(a, b) for a, b in zip(weights(meta), weights(loaded), strict=True))
    assert mean_return(loaded, -1.0, 1.0) == mean_return(meta, -1.0, 1.0)
    assert loaded.replay_buffer.transitions() == meta.replay_buffer.transitions()
    steps, updates = loaded.num_timesteps, loaded._n_updates
    loaded.learn(320, reset_num_timesteps=False)
    assert loaded.num_timesteps == steps + 320
    assert loaded._n_updates == updates + 160
    assert torch.isfinite(torch.cat([p.flatten() for p in weights(loaded)])).all()


def test_it_learns_without_rewards_in_the_context() -> None:
    model = toy(steps=1200, uses_reward=False)
    assert model.policy.window_terms == ("observation",)
    chosen, _ = model.predict({"observation": np.zeros((3, 1), np.float32)})  # a car that has none
    assert chosen.shape == (3, 1)


def test_features_tell_tasks_apart(meta: MQL) -> None:
    rng = np.random.default_rng(0)
    terms = meta.policy.window_terms
    batch = meta.replay_buffer.gather(meta.replay_buffer.sample(1000, rng), history=10, gamma=0.9, terms=terms)
    z = features(meta.policy, batch)
    assert z.shape == (1000, 32)
    goals = np.array([float(str(task).removeprefix("goal ")) for task in meta.replay_buffer.tasks])
    left = goals[batch.task] < 0.0
    assert fit_propensity(z[left], z[~left], 1.0).accuracy > 0.7
    shuffled = rng.permutation(left)
    assert fit_propensity(z[shuffled], z[~shuffled], 1.0).accuracy < 0.6


def test_a_broken_replay_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "replay.npz"
    broken.write_bytes(b"PK\x03\x04 and nothing else")
    with pytest.raises(OutlapError, match=r"replay\.npz: cannot be read as a replay"):
        toy().load_replay_buffer(broken)
    with pytest.raises(OutlapError, match="cannot be read as a replay"):
        toy().load_replay_buffer(tmp_path / "missing.npz")


def test_wrong_settings_are_named() -> None:
    with pytest.raises(OutlapError, match=r"preset is 'quick'; must be one of paper, fast"):
        toy(preset="quick")
