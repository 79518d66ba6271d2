"""One update: against a plain TD3 step, and where its gradients go."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch

from outlap.mql.config import TD3Config
from outlap.mql.learner import td3_update
from outlap.mql.policies import MQLPolicy
from outlap.mql.replay import ReplayBuffer

SPACE = gym.spaces.Dict(
    {
        "scan": gym.spaces.Box(0.0, 30.0, (20,), np.float32),
        "vel": gym.spaces.Box(-9.0, 9.0, (3,), np.float32),
        "previous_reward": gym.spaces.Box(-9.0, 9.0, (1,), np.float32),
    }
)
ACTIONS = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
STILL = TD3Config(policy_noise=0.0)  # no noise on target actions


def replay(n_steps: int = 1):
    """A batch from some random episodes."""
    rng = np.random.default_rng(0)
    buffer = ReplayBuffer(400, SPACE, 2, 4)

    def seen() -> dict[str, np.ndarray]:
        return {name: rng.normal(size=(4, *box.shape)).astype(np.float32) for name, box in SPACE.spaces.items()}  # type: ignore[misc]

    for episode in range(4):
        buffer.begin(np.arange(4), seen(), ["a"] * 4)
        for step in range(12):
            over = step == 11 and episode % 2 == 0
            buffer.add(np.arange(4), seen(), rng.uniform(-1, 1, (4, 2)), rng.normal(size=4), np.full(4, over))
    return buffer.gather(
        buffer.sample(64, rng), history=5, n_steps=n_steps, gamma=0.9, terms=("scan", "vel", "previous_reward")
    )


def policy(preset: str, **kwargs) -> MQLPolicy:
    torch.manual_seed(0)
    made = MQLPolicy(SPACE, ACTIONS, lambda _: 1e-2, preset=preset, history=5, **kwargs)
    with torch.no_grad():  # targets of their own, so that a mix-up shows
        for parameter in [*made.actor_target.parameters(), *made.critic_target.parameters()]:
            parameter.mul_(0.9)
    return made


def use_plain_gradient_descent(p: MQLPolicy) -> None:
    """In place of Adam, whose first step is the gradient's sign: where that is as good as 0, rounding decides."""
    p.make_optimizers(1e-2)
    p.actor_optimizer, p.critic_optimizer = (  # type: ignore[assignment]
        torch.optim.SGD(optimizer.param_groups[0]["params"], lr=1e-2)
        for optimizer in (p.actor_optimizer, p.critic_optimizer)
    )


def plain_losses(p: MQLPolicy, batch, n_steps: int):
    """The TD3 losses, each part computed anew and by itself."""

    def z(columns: torch.Tensor) -> torch.Tensor:
        each, rows = torch.arange(len(columns)), columns.t()
        return p.context(p.steps(batch.windows)[rows, each], batch.windows.valid[rows, each])

    here = torch.arange(5)[None].expand(len(batch.action), 5)
    there = here + batch.steps[:, None]
    names = p.critic.encoder.encoders
    now = {name: batch.observation[name] for name in names}
    then = {name: batch.next_observation[name] for name in names}
    actor_encoder = p.critic_target.encoder if p.shares_encoder else p.actor_target.encoder
    action = p.actor_target(actor_encoder(then), z(there).detach())
    q = p.critic_target(p.critic_target.encoder(then), action, z(there).detach()).min(0).values
    target = (batch.reward + batch.discount * q).detach()
    values = p.critic(p.critic.encoder(now), batch.action, z(here))
    each = ((values - target) ** 2).sum(0)
    mine = p.critic.encoder(now).detach() if p.shares_encoder else p.actor.encoder(now)
    chosen = p.actor(mine, z(here))
    value = p.critic(p.critic.encoder(now).detach(), chosen, z(here).detach())[0]
    return each, value


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("preset", ["paper", "fast"])
@pytest.mark.parametrize("max_grad_norm", [0.01, 1e9])
def test_an_update_is_a_plain_td3_step_of_both_losses(preset: str, n_steps: int, max_grad_norm: float) -> None:
    batch, settings = replay(n_steps), STILL.model_copy(update={"max_grad_norm": max_grad_norm})
    weights = torch.linspace(0.1, 3.0, 64)
    ours = policy(preset)
    theirs = copy.deepcopy(ours)
    for each in (ours, theirs):
        use_plain_gradient_descent(each)
    record = td3_update(ours, batch, settings, torch.Generator(), update_actor=True, weights=weights)

    each, value = plain_losses(theirs, batch, n_steps)
    critic_loss, actor_loss = (weights * each).mean(), -(weights * value).mean()
    assert record["critic_loss"].item() == pytest.approx(critic_loss.item(), rel=1e-5)
    assert record["actor_loss"].item() == pytest.approx(actor_loss.item(), rel=1e-5)
    assert record["critic_loss_variance"].item() == pytest.approx((weights * each).var().item(), rel=1e-4)
    assert record["td_error"].item() == pytest.approx(each.mean().item(), rel=1e-5)
    # Where the context reads embeddings, the actor's loss reaches their encoder too.
    heads, seen = list(theirs.critic.heads.parameters()), list(theirs.critic.encoder.parameters())
    context = list(theirs.context.parameters())
    actors = list(theirs.actor_optimizer.param_groups[0]["params"])
    both = [*seen, *context]
    of_critic = torch.autograd.grad(critic_loss, [*heads, *both], retain_graph=True)
    of_actor = torch.autograd.grad(actor_loss, [*both, *actors], materialize_grads=True)
    for parameter, gradient in zip(heads, of_critic, strict=False):
        parameter.grad = gradient
    for parameter, one, other in zip(both, of_critic[len(heads) :], of_actor, strict=False):
        parameter.grad = one + other
    for parameter, gradient in zip(actors, of_actor[len(both) :], strict=True):
        parameter.grad = gradient
    for gradient in (*of_critic[-len(context) :], *of_actor[len(seen) : len(both)]):  # both losses reach the context
        assert gradient.abs().max() > 0
    torch.nn.utils.clip_grad_norm_([*heads, *both], max_grad_norm)
    torch.nn.utils.clip_grad_norm_(actors, max_grad_norm)
    for mine, other in zip(ours.adapted_parameters(), theirs.adapted_parameters(), strict=True):
        assert mine.grad is not None
        assert other.grad is not None
        difference = torch.linalg.vector_norm(mine.grad - other.grad)
        assert difference <= 1e-4 * torch.linalg.vector_norm(other.grad)
    theirs.critic_optimizer.step()
    theirs.actor_optimizer.step()
    for mine, other in zip(ours.adapted_parameters(), theirs.adapted_parameters(), strict=True):
        torch.testing.assert_close(mine, other)


@pytest.mark.parametrize("copied", [False, True])
@pytest.mark.parametrize("preset", ["paper", "fast"])
def test_targets_follow_slowly_and_only_with_the_actor(preset: str, copied: bool) -> None:
    p = copy.deepcopy(policy(preset)) if copied else policy(preset)
    before = copy.deepcopy(p)
    td3_update(p, replay(), STILL, torch.Generator(), update_actor=False)
    still = [(p.critic_target, before.critic_target), (p.actor_target, before.actor_target)]
    still += [(p.actor.head, before.actor.head)]
    for modules in still:
        for now, then in zip(*(module.parameters() for module in modules), strict=True):
            assert torch.equal(now, then)
    td3_update(p, replay(), STILL, torch.Generator(), update_actor=True)
    networks = [(p.critic_target, before.critic_target, p.critic), (p.actor_target, before.actor_target, p.actor)]
    for modules in networks:
        for now, then, network in zip(*(module.parameters() for module in modules), strict=True):
            torch.testing.assert_close(now, then + STILL.tau * (network - then))


def test_the_proximal_term_pulls_towards_its_anchor() -> None:
    p = policy("fast")
    anchor = [torch.zeros_like(parameter) for parameter in p.adapted_parameters()]
    distance = sum(parameter.square().sum().item() for parameter in p.adapted_parameters())
    record = td3_update(
        p,
        replay(),
        STILL,
        torch.Generator(),
        update_actor=True,
        anchor=anchor,
        anchor_weight=1e6,
        weights=torch.zeros(64),
    )
    assert record["anchor_distance"].item() == pytest.approx(distance, rel=1e-5)
    assert sum(parameter.square().sum().item() for parameter in p.adapted_parameters()) < distance


def test_without_context_the_policy_is_deaf_to_its_history() -> None:
    windows = replay().windows.first(5)
    deaf, hears = policy("fast", uses_context=False), policy("fast")
    assert not deaf.encode(windows).any()
    assert hears.encode(windows).std(0).min() > 0
