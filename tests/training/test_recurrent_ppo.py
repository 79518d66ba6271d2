"""PPO with a memory: trained, loaded again, and a driver that remembers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from outlap.envs.race_config import RaceConfig
from outlap.training.ppo import RecurrentPPOConfig
from outlap.training.run import load_run
from outlap.training.session import train

ENV = RaceConfig(tracks=("ring5",), beams=16, observation=("scan", "vel"), scale_observations=True)
SMALL = RecurrentPPOConfig(
    env=ENV, total_steps=256, num_envs=8, n_steps=16, batch_size=64, n_epochs=1, net_arch=(16,), lstm_hidden=8
)


def test_a_run_is_its_own_algorithm_and_its_driver_remembers() -> None:
    run = load_run(train(SMALL, Path("run")).folder)
    assert run.config == SMALL
    driver = run.driver()
    rng = np.random.default_rng(0)
    first, second = (
        {"scan": rng.uniform(0, 1, (3, 16)).astype(np.float32), "vel": rng.uniform(-1, 1, (3, 3)).astype(np.float32)}
        for _ in range(2)
    )

    def after(*seen: dict[str, np.ndarray], begins: bool = False) -> np.ndarray:
        """What is done at the last of some observations; with `begins`, the second car's episode begins with it."""
        driver.begin(np.ones(3, bool))
        for observation in seen[:-1]:
            driver.act(observation)
        if begins:
            driver.begin(np.array([False, True, False]))
        return driver.act(seen[-1])

    alone, later = after(second), after(first, second)
    assert not np.allclose(alone, later)
    np.testing.assert_allclose(after(first, second, begins=True)[1], alone[1], atol=1e-6)
    np.testing.assert_allclose(after(first, second, begins=True)[[0, 2]], later[[0, 2]], atol=1e-6)
