"""One TD3 update of a context-conditioned policy (Fujimoto et al., 2018), with a weight for every transition."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from outlap.mql.batch import Batch
from outlap.mql.config import TD3Config
from outlap.mql.policies import MQLPolicy


class Critique(NamedTuple):
    """What the critics make of a batch."""

    embedding: Tensor  # (n, size) of the observation at the departure
    context: Tensor  # (n, hidden) z at the departure
    values: Tensor  # (2, n)
    errors: Tensor  # (n,) squared TD error of both critics together: the loss of every transition


def criticise(policy: MQLPolicy, batch: Batch, td3: TD3Config, noise: torch.Generator) -> Critique:
    """Return the critics' values and losses, with their gradients."""
    context, next_context = policy.contexts(batch.windows, batch.steps)
    with torch.no_grad():
        next_embedding = policy.critic_target.encoder(batch.next_observation)
        seen_by_actor = next_embedding
        if not policy.shares_encoder:
            seen_by_actor = policy.actor_target.encoder(batch.next_observation)
        next_action = policy.actor_target(seen_by_actor, next_context)
        jitter = td3.policy_noise * torch.randn(next_action.shape, generator=noise, device=policy.device)
        next_action = (next_action + jitter.clamp(-td3.noise_clip, td3.noise_clip)).clamp(-1.0, 1.0)
        next_value = policy.critic_target(next_embedding, next_action, next_context).amin(0)
        target = batch.reward + batch.discount * next_value

    embedding = policy.critic.encoder(batch.observation)
    values = policy.critic(embedding, batch.action, context)
    return Critique(embedding, context, values, (values - target).square().sum(0))


def td3_update(
    policy: MQLPolicy,
    batch: Batch,
    td3: TD3Config,
    noise: torch.Generator,
    *,
    update_actor: bool,
    weights: Tensor | float = 1.0,
    anchor: list[Tensor] | None = None,
    anchor_weight: float = 0.0,
) -> dict[str, Tensor]:
    """Change the policy by one batch: the critics, the context encoder and, if asked, actor and targets.

    The context is computed once. Both losses reach its encoder: the critics' directly, the actor's through the
    action that it chose; what the critics see of the context in the actor's loss is held fixed.

    Args:
        policy: to change.
        batch: transitions.
        td3: constants.
        noise: draws the noise of the target actions.
        update_actor: whether this is an update of the actor and the targets too.
        weights: (n,) of the transitions in both losses.
        anchor: values of `policy.adapted_parameters()` that the proximal term holds them to.
        anchor_weight: λ of the proximal term λ‖θ - anchor‖².

    Returns:
        What can be logged, without gradient: losses, the variance of the transitions' losses, the mean of Q, the
        distance ‖θ - anchor‖².
    """
    batch = batch.to(policy.device)
    critique = criticise(policy, batch, td3, noise)
    weighted = weights * critique.errors
    loss = critic_loss = weighted.mean()
    record = {
        "critic_loss": critic_loss, "critic_loss_variance": weighted.detach().var(),
        "td_error": critique.errors.detach().mean(), "q_value": critique.values.detach().mean(),
    }  # fmt: skip
    if update_actor:
        record["actor_loss"] = -(weights * _value_of_own_action(policy, batch, critique)).mean()
        loss = loss + record["actor_loss"]
    if anchor is not None:
        record["anchor_distance"] = _squared_distance(policy.adapted_parameters(), anchor)
        loss = loss + anchor_weight * record["anchor_distance"]

    policy.critic_optimizer.zero_grad()
    policy.actor_optimizer.zero_grad()
    loss.backward()
    record["grad_norm"] = _descend(policy.critic_optimizer, td3.max_grad_norm)
    if update_actor:
        _descend(policy.actor_optimizer, td3.max_grad_norm)
        get_ema_multi_avg_fn(1.0 - td3.tau)(policy.targets, policy.followed, 0)
    return {name: value.detach() for name, value in record.items()}


def _value_of_own_action(policy: MQLPolicy, batch: Batch, critique: Critique) -> Tensor:
    """Return the first critic's value (n,) of the actor's action; only the actor and its context get a gradient."""
    embedding = critique.embedding.detach()
    seen_by_actor = embedding if policy.shares_encoder else policy.actor.encoder(batch.observation)
    action = policy.actor(seen_by_actor, critique.context)
    return policy.critic(embedding, action, critique.context.detach(), for_actor=True)[0]


def _squared_distance(parameters: list[nn.Parameter], anchor: list[Tensor]) -> Tensor:
    pairs = zip(parameters, anchor, strict=True)
    return torch.stack([(parameter - fixed).square().sum() for parameter, fixed in pairs]).sum()


def _descend(optimizer: torch.optim.Optimizer, max_norm: float) -> Tensor:
    """Take a step along the gradient, clipped to a norm; return the norm before."""
    norm = nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_norm)
    optimizer.step()
    return norm
