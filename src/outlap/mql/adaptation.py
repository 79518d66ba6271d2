"""Adapting a meta-trained policy to a new task from a few of its transitions, and the replay of meta-training.

The meta-policy is never changed: what is adapted is a copy (Fakoor et al., 2020, algorithm 2; weights clipped by
Adaptive Beta Clipping or another rule).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from outlap.errors import OutlapError
from outlap.mql.buffers import Batch, HistoryBuffer
from outlap.mql.context_vec_env import ContextVecEnv
from outlap.mql.learner import td3_update
from outlap.mql.policies import MQLPolicy
from outlap.mql.propensity import AdaptiveBetaClip, ClipRule, Propensity, effective_sample_size, fit_propensity

if TYPE_CHECKING:
    from outlap.mql.mql import MQL


@dataclass(frozen=True)
class AdaptationSettings:
    """How an adaptation is made; the constants that the paper leaves out are the original's."""

    iterations: int = 10
    collect_steps: int = 100  # of each world of the new task, before every iteration
    on_task_steps: int = 5  # updates on the new task's transitions alone, β = 1, in every iteration
    replay_steps: int = 30  # then updates on the replay of meta-training, weighted by β
    batch_size: int = 256
    learning_rate: float = 1e-4
    clip: ClipRule = field(default_factory=AdaptiveBetaClip)
    regularization: float = 0.1  # C of the logistic regression
    classifier_size: int = 2000  # most transitions of either side that it is fitted on
    proximal: float = 1.0  # factor of the term λ‖θ - θ̂‖², λ = 1 - ESS; 0 leaves it out
    exploration_noise: float = 0.1  # of the actions that collect


@dataclass(frozen=True)
class AdaptationRecord:
    """What happened: a row an iteration, and a row a replay update."""

    iterations: list[dict[str, float]]
    updates: list[dict[str, float]]


def adapt(
    meta: MQL,
    task: VecEnv | HistoryBuffer,
    settings: AdaptationSettings | None = None,
    *,
    seed: int = 0,
    on_iteration: Callable[[int, MQLPolicy], None] | None = None,
    on_weights: Callable[[np.ndarray, np.ndarray], None] | None = None,
) -> tuple[MQLPolicy, AdaptationRecord]:
    """A copy of the meta-policy, adapted to a task.

    Args:
        meta: with its replay; neither its networks nor its optimizers nor its replay are changed.
        task: an environment to collect from, or transitions that were collected already.
        settings: constants.
        seed: of everything that is drawn.
        on_iteration: called with the number of each iteration that is done, and the policy as it stands.
        on_weights: called with the weights (n,) of each batch of the replay, before and after the clipping.

    Where the transitions were collected already, equal seeds draw equal batches, whatever the clip rule.

    Raises OutlapError where there is no transition of either side.
    """
    settings = settings or AdaptationSettings()
    if not meta.replay_buffer.transitions():
        raise OutlapError("adapt: the meta-policy has no replay; load it with load_replay_buffer")
    rng = np.random.default_rng(seed)
    noise = torch.Generator(meta.device).manual_seed(seed)
    policy = copy.deepcopy(meta.policy)
    policy.make_optimizers(settings.learning_rate)
    anchor = [parameter.detach().clone() for parameter in policy.adapted_parameters()]
    collector = None if isinstance(task, HistoryBuffer) else _Collector(meta, task, settings, rng)
    new = task if isinstance(task, HistoryBuffer) else collector.buffer  # type: ignore[union-attr]
    clip = settings.clip.start()
    record = AdaptationRecord([], [])
    updates = 0
    constants = meta.settings

    def update(batch: Batch, **weighting: Any) -> dict[str, float]:
        nonlocal updates
        updates += 1
        actor_too = updates % constants.policy_delay == 0
        return _numbers(td3_update(policy, batch, constants, noise, update_actor=actor_too, **weighting))

    for iteration in range(settings.iterations):
        if collector is not None:
            collector.collect(policy)
        propensity = fit_to(meta, new, settings, rng)
        for _ in range(settings.on_task_steps):
            on_task = update(meta.draw(new, settings.batch_size, rng))
        first = len(record.updates)
        for _ in range(settings.replay_steps):
            batch = meta.draw(meta.replay_buffer, settings.batch_size, rng)
            # Features are the meta-policy's throughout, so that β means one thing.
            raw = propensity.beta(features(meta.policy, batch))
            beta, level = clip.clip(raw)
            if on_weights is not None:
                on_weights(raw, beta)
            ess = effective_sample_size(beta)
            pull = settings.proximal * (1.0 - ess)
            weights = torch.as_tensor(beta, dtype=torch.float32, device=policy.device)
            numbers = update(batch, weights=weights, anchor=anchor, anchor_weight=pull)
            record.updates.append(
                {
                    "iteration": iteration,
                    "beta_mean": float(raw.mean()),
                    "beta_max": float(raw.max()),
                    "clipped_beta_mean": float(beta.mean()),
                    "clipped_beta_max": float(beta.max()),
                    "clip_level": level,
                    "clipped_share": float((raw > level).mean()),
                    "effective_sample_size": ess,
                    "proximal_weight": pull,
                    "classifier_accuracy": propensity.accuracy,
                    **numbers,
                }
            )
        rows = record.updates[first:]
        record.iterations.append(
            {
                "iteration": iteration,
                "task_transitions": new.transitions(),
                "classifier_accuracy": propensity.accuracy,
                **({"on_task_critic_loss": on_task["critic_loss"]} if settings.on_task_steps else {}),
                **{
                    name: float(np.mean([row[name] for row in rows]))
                    for name in (rows[0] if rows else {})
                    if name in LOGGED
                },
            }
        )
        if on_iteration is not None:
            on_iteration(iteration, policy)
    return policy, record


LOGGED = (
    "beta_mean", "clipped_beta_mean", "clip_level", "clipped_share", "effective_sample_size", "proximal_weight",
    "critic_loss", "critic_loss_variance", "td_error", "anchor_distance",
)  # fmt: skip


def collect(meta: MQL, env: VecEnv, settings: AdaptationSettings, *, seed: int = 0) -> HistoryBuffer:
    """As many transitions of a task as an adaptation collects, all of them driven by the meta-policy."""
    collector = _Collector(meta, env, settings, np.random.default_rng(seed))
    for _ in range(settings.iterations):
        collector.collect(meta.policy)
    return collector.buffer


def features(policy: MQLPolicy, batch: Batch) -> np.ndarray:
    """What the classifier sees of transitions: the context at their departure, (n, hidden)."""
    with torch.no_grad():
        return policy.encode(batch.windows.first(policy.history)).cpu().numpy()


def fit_to(meta: MQL, new: HistoryBuffer, settings: AdaptationSettings, rng: np.random.Generator) -> Propensity:
    """The classifier between transitions of a new task and the replay of the meta-training."""
    sides = []
    for buffer in (new, meta.replay_buffer):
        size = min(settings.classifier_size, buffer.transitions())
        if not size:
            raise OutlapError("adapt: there is no transition of the new task; collect some")
        sides.append(features(meta.policy, meta.draw(buffer, size, rng)))
    return fit_propensity(sides[0], sides[1], settings.regularization)


def _numbers(record: dict[str, torch.Tensor]) -> dict[str, float]:
    return {name: value.item() for name, value in record.items()}


class _Collector:
    """Drives in the new task with the policy as it stands, and keeps what it sees."""

    def __init__(self, meta: MQL, env: VecEnv, settings: AdaptationSettings, rng: np.random.Generator) -> None:
        self.env = env if isinstance(env, ContextVecEnv) else ContextVecEnv(env)
        self.settings, self.rng = settings, rng
        rows = 2 * self.env.num_envs * (settings.collect_steps * settings.iterations + 2)
        space = meta.observation_space
        self.buffer = HistoryBuffer(rows, space, self.env.action_space.shape[0], self.env.num_envs)  # type: ignore[arg-type, index]
        self.observation: Any = self.env.reset()
        self.buffer.begin_all(self.env, self.observation)

    def collect(self, policy: MQLPolicy) -> None:
        for _ in range(self.settings.collect_steps):
            action = policy.explore(self.observation, self.buffer, self.settings.exploration_noise, self.rng)
            self.observation, reward, dones, infos = self.env.step(policy.unscale_action(action))
            self.buffer.add_step(self.env, self.observation, action, reward, dones, infos)
