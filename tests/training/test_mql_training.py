"""A meta-training as a run: it is stopped, goes on with its replay, and drives in an evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from outlap.config import load_config
from outlap.envs.race_config import RaceConfig
from outlap.errors import OutlapError
from outlap.evaluation.rollout import evaluate
from outlap.mql.mql import MQL
from outlap.mql.replay import ReplayBuffer
from outlap.track import load_track
from outlap.training.mql import MQLConfig
from outlap.training.run import load_run
from outlap.training.session import train
from stopped_training import stopped_after

ENV = RaceConfig(
    tracks=("ring5",),
    beams=16,
    control_interval=5,
    speed_range=(0.0, 3.0),
    observation=("scan", "vel", "previous_reward"),
    scale_observations=True,
    termination={"time_limit": 2.0},  # type: ignore[arg-type]
)
SMALL = MQLConfig(
    env=ENV, total_steps=640, num_envs=8, learning_starts=64, batch_size=32, buffer_size=2000, checkpoint_every=256
)


def test_a_stopped_run_goes_on_with_its_replay() -> None:
    stopped_after(256, SMALL, Path("run"))
    run = load_run("run")
    assert isinstance(run.config, MQLConfig)
    assert load_config(MQLConfig, run.folder / "config.yaml") == SMALL
    before = ReplayBuffer.load(run.replay_path)
    assert before.transitions() == 256
    train(run.config, run.folder, resume=run)
    after = ReplayBuffer.load(run.replay_path)
    assert after.transitions() == 640
    for name in ("scan", "vel"):  # what was seen before the stop, and then the rest
        np.testing.assert_array_equal(after.observation[name][: before.added], before.observation[name][: before.added])
    model = MQL.load(run.policy_path, device="cpu")
    assert model.num_timesteps == 640
    # All but those that the stop came before.
    assert model._n_updates == SMALL.updates_per_step * ((640 - 64) // 8 - 1)
    assert set(after.tasks) == {"ring5"}


def test_an_evaluation_does_not_depend_on_how_many_race_at_once() -> None:
    run = train(SMALL, Path("run"))
    rows = []
    for worlds in (3, 6):
        driver = run.driver()
        rows.append(evaluate(driver, ENV, [load_track("ring5")], episodes=6, seed=1, num_worlds=worlds))
    assert rows[0].equals(rows[1])


def test_a_context_needs_the_reward_that_it_is_to_use() -> None:
    config = SMALL.model_copy(update={"env": ENV.model_copy(update={"observation": ("scan", "vel")})})
    run = train(config, Path("run"))  # the environment's wrapper tells it while learning
    assert "previous_reward" in MQL.load(run.policy_path, device="cpu").policy.window_terms
    driver = run.driver()
    assert "previous_reward" in driver.observation_terms  # and the evaluation asks for it by name


def test_a_run_of_another_algorithm_is_named() -> None:
    stopped_after(256, SMALL, Path("run"))
    path = Path("run/config.yaml")
    path.write_text(path.read_text().replace("algorithm: mql", "algorithm: dqn"))
    with pytest.raises(OutlapError, match=r"algorithm is 'dqn'; must be one of ppo, recurrent-ppo, mql"):
        load_run("run")


def test_rewards_are_observed_whatever_else_is() -> None:
    """Else they would be told as they are in training, and divided by their scale in races."""
    assert MQLConfig(env=RaceConfig(observation=("scan", "vel"))).env.observation == ("scan", "vel", "previous_reward")
    assert MQLConfig().env.observation.count("previous_reward") == 1
