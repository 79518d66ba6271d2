"""One TD3 update of a context-conditioned policy (Fujimoto et al., 2018), with a weight for every transition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from outlap.mql.buffers import Batch
from outlap.mql.policies import MQLPolicy, to_tensor


@dataclass(frozen=True)
class TD3Settings:
    """Constants of an update."""

    tau: float = 0.005  # share of the targets' move towards the networks
    policy_noise: float = 0.2  # standard deviation of the target action's noise
    noise_clip: float = 0.5  # largest such noise
    policy_delay: int = 2  # updates of the critics for one of the actor and the targets
    max_grad_norm: float = 10.0


class Criticism(NamedTuple):
    """What the critics make of a batch."""

    seen: dict[str, Tensor]  # (n, size) of each term
    embedding: Tensor  # (n, size) of what is seen
    context: Tensor  # (n, hidden)
    values: Tensor  # (2, n)
    errors: Tensor  # (n,) squared TD error of both critics together: the loss of every transition


def criticise(policy: MQLPolicy, batch: Batch, settings: TD3Settings, noise: torch.Generator) -> Criticism:
    """The critics' values and losses, with their gradients."""
    device = policy.device
    action, reward, discount = (to_tensor(x, device) for x in (batch.action, batch.reward, batch.discount))
    seen = {name: to_tensor(batch.observation[name], device) for name in policy.critic.encoder.encoders}
    seen_next = {name: to_tensor(batch.next_observation[name], device) for name in policy.critic.encoder.encoders}
    context, context_next = _contexts(policy, batch)

    with torch.no_grad():
        embedding_next = policy.critic_target.encoder(seen_next)
        chosen = policy.actor_target(
            embedding_next if policy.shares_encoder else policy.actor_target.encoder(seen_next), context_next
        )
        jitter = torch.randn(chosen.shape, generator=noise, device=device) * settings.policy_noise
        chosen = (chosen + jitter.clamp(-settings.noise_clip, settings.noise_clip)).clamp(-1.0, 1.0)
        target = reward + discount * policy.critic_target(embedding_next, chosen, context_next).amin(0)

    embedding = policy.critic.encoder(seen)
    values = policy.critic(embedding, action, context)
    return Criticism(seen, embedding, context, values, (values - target).square().sum(0))


def td3_update(
    policy: MQLPolicy,
    batch: Batch,
    settings: TD3Settings,
    noise: torch.Generator,
    *,
    update_actor: bool,
    weights: Tensor | None = None,
    anchor: list[Tensor] | None = None,
    anchor_weight: float = 0.0,
) -> dict[str, Tensor]:
    """Change the policy by one batch: the critics, the context encoder and, if asked, actor and targets.

    The context is computed once. Both losses reach its encoder: the critics' directly, the actor's through the
    action that it chose; what the critics see of the context in the actor's loss is held fixed.

    Args:
        policy: to change.
        batch: transitions.
        settings: constants.
        noise: draws the noise of the target actions.
        update_actor: whether this is an update of the actor and the targets too.
        weights: (n,) of the transitions in both losses; none: 1 each.
        anchor: values of `policy.adapted_parameters()` that the proximal term holds them to.
        anchor_weight: λ of the proximal term λ‖θ - anchor‖².

    Returns:
        What can be logged, without gradient: losses, the variance of the transitions' losses, the mean of Q, the
        distance ‖θ - anchor‖².
    """
    seen, embedding, context, values, each = criticise(policy, batch, settings, noise)
    shared = policy.shares_encoder
    critic_loss = (each if weights is None else weights * each).mean()
    loss = critic_loss
    record = {}
    if update_actor:
        seen_by_actor = embedding.detach() if shared else policy.actor.encoder(seen)
        chosen = policy.actor(seen_by_actor, context)
        value = policy.critic(embedding.detach(), chosen, context.detach(), for_actor=True)[0]
        actor_loss = -(value if weights is None else weights * value).mean()
        loss = loss + actor_loss
        record["actor_loss"] = actor_loss.detach()
    if anchor is not None:
        distance = sum((p - at).square().sum() for p, at in zip(policy.adapted_parameters(), anchor, strict=True))
        assert isinstance(distance, Tensor)
        loss = loss + anchor_weight * distance
        record["anchor_distance"] = distance.detach()

    for parameter in policy.adapted_parameters():
        parameter.grad = None
    loss.backward()
    grad_norm = policy.critic_optimizer.step_clipped(settings.max_grad_norm)
    if update_actor:
        policy.actor_optimizer.step_clipped(settings.max_grad_norm)
        with torch.no_grad():
            torch._foreach_lerp_(policy.targets, policy.followed, settings.tau)  # type: ignore[arg-type]
    weighted = each.detach() if weights is None else weights * each.detach()
    return {
        "critic_loss": critic_loss.detach(),
        "critic_loss_variance": weighted.var(),
        "td_error": each.detach().mean(),
        "q_value": values.detach().mean(),
        "grad_norm": grad_norm.detach(),
        **record,
    }


def _contexts(policy: MQLPolicy, batch: Batch) -> tuple[Tensor, Tensor]:
    """z where the transitions depart, and, without gradient, where they arrive."""
    if not policy.uses_context:
        zero = torch.zeros(len(batch.action), policy.context.hidden, device=policy.device)
        return zero, zero
    steps, valid = policy.steps(batch.windows)
    later = torch.as_tensor(batch.steps, device=policy.device)
    return policy.context(steps, valid, policy.history, later)
