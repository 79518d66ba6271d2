"""The same seed and as many threads of PyTorch give the same rows and the same weights, bit for bit.

Those of Numba change nothing at all: see tests/simulator/test_batch.py.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from outlap.drivers.policy import PolicyDriver
from outlap.envs import RaceVectorEnv, SB3VecEnv
from outlap.envs.race_config import RaceConfig
from outlap.evaluation.rollout import evaluate
from outlap.experiments.figures import read_learning
from outlap.mql.adaptation import adapt
from outlap.mql.config import AdaptationConfig
from outlap.mql.mql import MQL
from outlap.track import load_track
from outlap.training.config import TrainingConfig
from outlap.training.mql import MQLConfig
from outlap.training.ppo import PPOConfig, RecurrentPPOConfig
from outlap.training.run import Run, load_run
from outlap.training.session import Progress, train

ENV = RaceConfig(
    tracks=("ring5",), beams=32, control_interval=5, speed_range=(0.0, 4.0), observation=("scan", "vel"),
    scale_observations=True, vehicle={"mu": (0.5, 1.1)}, lidar={"noise_std": 0.02},  # type: ignore[arg-type]
    termination={"time_limit": 2.0},  # type: ignore[arg-type]
)  # fmt: skip
# Wide layers and large batches: PyTorch leaves small ones to one thread.
CONFIGS: dict[str, TrainingConfig] = {
    "ppo": PPOConfig(env=ENV, total_steps=1024, num_envs=16, n_steps=32, batch_size=512, n_epochs=2,
                     net_arch=(128, 128), checkpoint_every=10**9),
    "mql": MQLConfig(env=ENV, total_steps=512, num_envs=8, learning_starts=440, batch_size=256, buffer_size=2000,
                     checkpoint_every=10**9),
}  # fmt: skip


@pytest.fixture(autouse=True)
def as_many_threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def trained(algorithm: str, threads: int, name: str) -> tuple[Run, list[tuple], list[np.ndarray]]:
    """A run, its learning curve and its final weights."""
    rows: list[tuple] = []

    def note(now: Progress) -> None:
        rows.append((now.steps, now.crash_rate, now.mean_speed_mps, now.progress_m))

    config = CONFIGS[algorithm].model_copy(update={"threads": threads})
    run = train(config, Path(name), on_progress=note)
    assert torch.get_num_threads() == threads
    state = config.model_class().load(run.policy_path, device="cpu").policy.state_dict()
    return run, rows, [value.numpy() for value in state.values()]


@pytest.mark.parametrize("algorithm", CONFIGS)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_training_repeats_its_learning_curve_and_its_weights(algorithm, threads):
    (_, rows, weights), (_, rows_again, weights_again) = (trained(algorithm, threads, name) for name in "ab")
    assert len(rows) == 2
    assert repr(rows) == repr(rows_again)  # NaN, where no episode has ended, is NaN again
    for one, other in zip(weights, weights_again, strict=True):
        np.testing.assert_array_equal(one, other)


class Killed(Exception):
    """Ends a training as a kill does: nothing is saved."""


FREQUENT = {"env": ENV, "threads": 1, "total_steps": 1024, "checkpoint_every": 256}  # checkpoints


@pytest.mark.parametrize(
    "config",
    [
        PPOConfig(**FREQUENT, num_envs=8, n_steps=8, batch_size=32, n_epochs=1, net_arch=(16,)),
        RecurrentPPOConfig(**FREQUENT, num_envs=8, n_steps=8, batch_size=32, n_epochs=1, net_arch=(16,), lstm_hidden=8),
        MQLConfig(**FREQUENT, num_envs=4, learning_starts=400, batch_size=16, buffer_size=700),
    ],
    ids=lambda config: config.algorithm,
)
def test_a_training_resumed_from_a_checkpoint_is_the_one_that_was_never_stopped(config: TrainingConfig):
    undisturbed, stopped = Path("undisturbed"), Path("stopped")
    run = train(config, undisturbed)

    def kill(now: Progress) -> None:
        if now.steps > 0.6 * config.total_steps:
            raise Killed

    with pytest.raises(Killed):
        train(config, stopped, on_progress=kill)
    steps = [int(path.stem.removeprefix("step_")) for path in load_run(stopped).checkpoints()]
    assert steps == [config.total_steps // 2, config.total_steps // 4]
    time.sleep(1.1)  # TensorBoard orders the files of a log by the second of their names first
    for rng in (torch.manual_seed, np.random.seed):  # whatever the next process begins with
        rng(99)
    same = train(config, stopped, resume=load_run(stopped))
    weights, weights_again = (
        config.model_class().load(each.policy_path, device="cpu").policy.state_dict() for each in (run, same)
    )
    for name, value in weights.items():
        np.testing.assert_array_equal(value.numpy(), weights_again[name].numpy())
    curve, curve_again = (read_learning(each.folder) for each in (run, same))
    assert len(curve) > 2
    pd.testing.assert_frame_equal(curve, curve_again)
    assert len(list(stopped.glob("tensorboard/*"))) == 2  # one a session: of two in one second, either may come first
    if config.algorithm == "mql":
        with np.load(run.replay_path) as one, np.load(same.replay_path) as other:
            assert one.files == other.files
            for name in one.files:
                np.testing.assert_array_equal(one[name], other[name])
        assert not list(stopped.glob("checkpoints/*.npz"))  # but the finished one's


@pytest.mark.parametrize("threads", [1, 2])
def test_an_adaptation_and_an_evaluation_repeat_their_rows(threads):
    trained("mql", 1, "meta")
    torch.set_num_threads(threads)
    rows, updates, weights = [], [], []
    for _ in range(2):
        run = load_run("meta")
        meta = MQL.load(run.policy_path, device="cpu")
        meta.load_replay_buffer(run.replay_path)
        task = SB3VecEnv(RaceVectorEnv(4, run.config.env))
        task.seed(5)
        settings = AdaptationConfig(iterations=1, collect_steps=20, on_task_steps=2, replay_steps=3)
        policy, record = adapt(meta, task, settings, seed=2)
        updates.append(repr(record.updates))
        weights.append(np.concatenate([value.numpy().ravel() for value in policy.state_dict().values()]))
        driver = PolicyDriver(meta, scale_observations=True)
        rows.append(evaluate(driver, run.config.env, [load_track("ring5")], episodes=8, seed=1))
    assert updates[0] == updates[1]
    np.testing.assert_array_equal(*weights)
    assert rows[0].equals(rows[1])
