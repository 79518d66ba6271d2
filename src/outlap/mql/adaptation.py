"""Adapting a meta-trained policy to a new task from a few of its transitions, and the replay of meta-training.

The meta-policy is never changed: what is adapted is a copy (Fakoor et al., 2020, algorithm 2; weights clipped by
Adaptive Beta Clipping or another rule).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from outlap.errors import OutlapError
from outlap.mql.batch import Batch
from outlap.mql.collector import Collector
from outlap.mql.config import AdaptationConfig
from outlap.mql.learner import td3_update
from outlap.mql.mql import MQL
from outlap.mql.policies import MQLPolicy
from outlap.mql.propensity import ClipState, Propensity, effective_sample_size, fit_propensity
from outlap.mql.replay import ReplayBuffer

AVERAGED = (
    "beta_mean", "clipped_beta_mean", "clip_level", "clipped_share", "effective_sample_size", "proximal_weight",
    "critic_loss", "critic_loss_variance", "td_error", "anchor_distance",
)  # fmt: skip


@dataclass(frozen=True)
class AdaptationRecord:
    """What happened: a row an iteration, and a row a replay update."""

    iterations: list[dict[str, float]] = field(default_factory=list)
    updates: list[dict[str, float]] = field(default_factory=list)


def adapt(
    meta: MQL,
    task: VecEnv | ReplayBuffer,
    config: AdaptationConfig | None = None,
    *,
    seed: int = 0,
    on_iteration: Callable[[int, MQLPolicy], None] | None = None,
    on_weights: Callable[[np.ndarray, np.ndarray], None] | None = None,
) -> tuple[MQLPolicy, AdaptationRecord]:
    """Return a copy of the meta-policy, adapted to a task, and what happened.

    Args:
        meta: with its replay; neither its networks nor its optimizers nor its replay are changed.
        task: an environment to collect from, or transitions that were collected already.
        config: constants.
        seed: of everything that is drawn.
        on_iteration: called with the number of each iteration that is done, and the policy as it stands.
        on_weights: called with the weights (n,) of each batch of the replay, before and after the clipping.

    Where the transitions were collected already, equal seeds draw equal batches, whatever the clip rule.

    Raises OutlapError where there is no transition of either side.
    """
    config = config or AdaptationConfig()
    if not meta.replay_buffer.transitions():
        raise OutlapError("adapt: the meta-policy has no replay; load it with load_replay_buffer")
    rng = np.random.default_rng(seed)
    collector = None if isinstance(task, ReplayBuffer) else _collector(meta, task, config, rng)
    new = task if isinstance(task, ReplayBuffer) else collector.buffer  # type: ignore[union-attr]
    learner = _Learner(meta, config, seed)
    clip = config.clip.start()
    record = AdaptationRecord()
    for iteration in range(config.iterations):
        if collector is not None:
            collector.collect(learner.policy, config.collect_steps)
        propensity = fit_to(meta, new, config, rng)
        row: dict[str, float] = {
            "iteration": iteration,
            "task_transitions": new.transitions(),
            "classifier_accuracy": propensity.accuracy,
        }
        for _ in range(config.on_task_steps):
            row["on_task_critic_loss"] = learner.update(meta.draw(new, config.batch_size, rng))["critic_loss"]
        rows = []
        for _ in range(config.replay_steps):
            batch = meta.draw(meta.replay_buffer, config.batch_size, rng)
            rows.append({"iteration": iteration, **learner.weighted_update(batch, propensity, clip, on_weights)})
        if rows:
            row |= {name: float(np.mean([each[name] for each in rows])) for name in AVERAGED}
        record.iterations.append(row)
        record.updates.extend(rows)
        if on_iteration is not None:
            on_iteration(iteration, learner.policy)
    return learner.policy, record


def collect(meta: MQL, env: VecEnv, config: AdaptationConfig, *, seed: int = 0) -> ReplayBuffer:
    """Return as many transitions of a task as an adaptation collects, all of them driven by the meta-policy."""
    collector = _collector(meta, env, config, np.random.default_rng(seed))
    collector.collect(meta.policy, config.iterations * config.collect_steps)
    return collector.buffer


def features(policy: MQLPolicy, batch: Batch) -> np.ndarray:
    """Return what the classifier sees of transitions: the context at their departure, (n, hidden)."""
    with torch.no_grad():
        return policy.encode(batch.windows.first(policy.history)).cpu().numpy()


def fit_to(meta: MQL, new: ReplayBuffer, config: AdaptationConfig, rng: np.random.Generator) -> Propensity:
    """Return the classifier between transitions of a new task and the replay of the meta-training."""
    sides = []
    for buffer in (new, meta.replay_buffer):
        size = min(config.classifier_size, buffer.transitions())
        if not size:
            raise OutlapError("adapt: there is no transition of the new task; collect some")
        sides.append(features(meta.policy, meta.draw(buffer, size, rng)))
    return fit_propensity(sides[0], sides[1], config.regularization)


class _Learner:
    """A copy of the meta-policy, and its updates."""

    def __init__(self, meta: MQL, config: AdaptationConfig, seed: int) -> None:
        self.meta, self.proximal = meta, config.proximal
        self.policy = copy.deepcopy(meta.policy)
        self.policy.make_optimizers(config.learning_rate)
        self.anchor = [parameter.detach().clone() for parameter in self.policy.adapted_parameters()]
        self.noise = torch.Generator(meta.device).manual_seed(seed)
        self.updates = 0

    def update(self, batch: Batch, **weighting: Any) -> dict[str, float]:
        """Make one update; return what can be logged."""
        self.updates += 1
        update_actor = self.updates % self.meta.td3.policy_delay == 0
        numbers = td3_update(self.policy, batch, self.meta.td3, self.noise, update_actor=update_actor, **weighting)
        return {name: value.item() for name, value in numbers.items()}

    def weighted_update(
        self,
        batch: Batch,
        propensity: Propensity,
        clip: ClipState,
        on_weights: Callable[[np.ndarray, np.ndarray], None] | None,
    ) -> dict[str, float]:
        """Make one update from the replay, weighted by clipped β; return what can be logged."""
        # Features are the meta-policy's throughout, so that β means one thing.
        raw = propensity.beta(features(self.meta.policy, batch))
        beta, level = clip.clip(raw)
        if on_weights is not None:
            on_weights(raw, beta)
        ess = effective_sample_size(beta)
        pull = self.proximal * (1.0 - ess)
        weights = torch.as_tensor(beta, dtype=torch.float32, device=self.policy.device)
        return {
            "beta_mean": float(raw.mean()),
            "beta_max": float(raw.max()),
            "clipped_beta_mean": float(beta.mean()),
            "clipped_beta_max": float(beta.max()),
            "clip_level": level,
            "clipped_share": float((raw > level).mean()),
            "effective_sample_size": ess,
            "proximal_weight": pull,
            "classifier_accuracy": propensity.accuracy,
            **self.update(batch, weights=weights, anchor=self.anchor, anchor_weight=pull),
        }


def _collector(meta: MQL, env: VecEnv, config: AdaptationConfig, rng: np.random.Generator) -> Collector:
    steps = config.iterations * config.collect_steps
    space = meta.observation_space
    assert isinstance(space, gym.spaces.Dict)
    return Collector(env, space, steps, config.exploration_noise, rng)
