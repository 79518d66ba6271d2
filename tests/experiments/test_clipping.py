"""Clip rules on equal data: that it is equal, and that the measures do not reward small weights."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from outlap.experiments.clipping import BETA_EDGES, compare_rules, gradient_variance
from outlap.mql.adaptation import collect, features, fit_to
from outlap.mql.config import AdaptationConfig
from outlap.mql.learner import criticise
from outlap.mql.mql import MQL
from outlap.mql.propensity import CLIP_RULES
from outlap.mql.replay import ReplayBuffer
from toy_tasks import HiddenGoal

SETTINGS = AdaptationConfig(iterations=2, collect_steps=20, on_task_steps=1, replay_steps=4, batch_size=32)


@pytest.fixture(scope="module")
def meta() -> MQL:
    torch.set_num_threads(1)
    model = MQL(
        env=HiddenGoal(8, -1.0, 1.0), learning_starts=80, batch_size=32, seed=0, device="cpu",
        policy_kwargs={"preset": "fast", "history": 4},
    )  # fmt: skip
    return model.learn(800)


@pytest.fixture(scope="module")
def new(meta: MQL) -> ReplayBuffer:
    return collect(meta, HiddenGoal(8, 1.4, 1.4, seed=3), SETTINGS)


def test_as_much_is_collected_as_in_an_adaptation(new: ReplayBuffer):
    assert new.transitions() == 8 * SETTINGS.collect_steps * SETTINGS.iterations


def test_all_rules_see_the_same_weights_and_batches(meta: MQL, new: ReplayBuffer):
    before = [parameter.detach().clone() for parameter in meta.policy.parameters()]
    shares: list[float] = []
    found = compare_rules(meta, new, SETTINGS, 5, 4, shares.append)
    updates, histograms = found["updates"], found["histograms"]
    by_rule = {rule: updates.loc[updates["rule"] == rule] for rule in CLIP_RULES}
    for name in ("beta_mean", "beta_max"):  # before clipping
        values = {rule: mine[name].tolist() for rule, mine in by_rule.items()}
        assert values["none"] == values["fixed"] == values["abc"]
    assert by_rule["abc"]["clipped_beta_max"].to_numpy()[0] < by_rule["none"]["clipped_beta_max"].to_numpy()[0]
    # The first update is from the same parameters: only the weights differ.
    assert len({mine["td_error"].to_numpy()[0] for mine in by_rule.values()}) == 1
    drawn = SETTINGS.iterations * SETTINGS.replay_steps * SETTINGS.batch_size
    for rule in CLIP_RULES:
        mine = histograms.loc[histograms["rule"] == rule]
        assert (mine["before"].sum(), mine["after"].sum()) == (drawn, drawn)
    same = histograms.loc[histograms["rule"] == "none"]
    assert same["before"].tolist() == same["after"].tolist()
    assert len(same) == len(BETA_EDGES) - 1
    iterations = found["iterations"]
    assert iterations.groupby("rule").size().to_dict() == dict.fromkeys(CLIP_RULES, SETTINGS.iterations)
    assert shares == sorted(shares)
    assert shares[-1] < 1.0
    assert all(torch.equal(a, b) for a, b in zip(before, meta.policy.parameters(), strict=True))


def test_the_variance_of_the_gradient_is_that_of_gradients_kept_one_by_one(meta: MQL, new: ReplayBuffer):
    table = gradient_variance(meta, new, SETTINGS, seed=2, batches=5).set_index("rule")
    # The same batches, drawn in the same order; gradients of β = 1 and of unclipped weights as rows of a matrix.
    rng, noise = np.random.default_rng(2), torch.Generator().manual_seed(2)
    policy = copy.deepcopy(meta.policy)
    propensity = fit_to(meta, new, SETTINGS, rng)
    rows: dict[str, list[np.ndarray]] = {"uniform": [], "none": []}
    for _ in range(5):
        batch = meta.draw(meta.replay_buffer, SETTINGS.batch_size, rng)
        beta = propensity.beta(features(meta.policy, batch))
        state = noise.get_state()
        for name, weights in (("uniform", np.ones_like(beta)), ("none", 7.0 * beta)):  # any factor is divided out
            noise.set_state(state)
            policy.zero_grad()
            errors = criticise(policy, batch, meta.td3, noise).errors
            (torch.as_tensor(weights / weights.mean(), dtype=torch.float32) * errors).mean().backward()
            gradient = [p.grad for p in (*policy.critic.parameters(), *policy.context.parameters())]
            rows[name].append(np.concatenate([g.numpy().ravel().astype(np.float64) for g in gradient if g is not None]))
    for name, gradients in rows.items():
        matrix = np.array(gradients)
        assert table.loc[name, "gradient_variance"] == pytest.approx(matrix.var(axis=0, ddof=1).sum(), rel=1e-3)
        assert table.loc[name, "gradient_norm2"] == pytest.approx(np.square(matrix.mean(axis=0)).sum(), rel=1e-3)
    assert table.loc["uniform", "effective_sample_size"] == pytest.approx(1.0)
    assert table.loc["none", "effective_sample_size"] < table.loc["abc", "effective_sample_size"]
