"""What clip rules do to propensity weights and to learning with them, on equal data (the paper's figure 2)."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pandas as pd
import torch

from outlap.mql.adaptation import adapt, features, fit_to
from outlap.mql.config import AdaptationConfig
from outlap.mql.learner import criticise
from outlap.mql.mql import MQL
from outlap.mql.propensity import CLIP_RULES, effective_sample_size
from outlap.mql.replay import ReplayBuffer

# log10 of the edges of a histogram of β, which reaches from exp(-30) to exp(30).
BETA_EDGES = np.linspace(-13.2, 13.2, 133)


def compare_rules(
    meta: MQL,
    new: ReplayBuffer,
    config: AdaptationConfig,
    seed: int,
    gradient_batches: int,
    report: Callable[[float], None],
) -> dict[str, pd.DataFrame]:
    """Adapt with every clip rule to the same transitions, by the same batches.

    Args:
        meta: to adapt, with its replay.
        new: transitions of the task.
        config: of the adaptations; their clip rule is replaced.
        seed: of all batches, equal for every rule.
        gradient_batches: see `gradient_variance`.
        report: called with the share that is done.

    Returns:
        `updates`: a row a replay update and rule, and `iterations`: a row an iteration and rule, see
        `AdaptationRecord`. `histograms`: counts of β over all updates before and after the clipping, by BETA_EDGES.
        `gradients`: of `gradient_variance`.
    """
    updates, iterations, histograms = [], [], []
    for number, (name, rule) in enumerate(CLIP_RULES.items()):
        counts = np.zeros((2, len(BETA_EDGES) - 1), np.int64)

        def count(raw: np.ndarray, clipped: np.ndarray, counts: np.ndarray = counts) -> None:
            for row, beta in zip(counts, (raw, clipped), strict=True):
                row += np.histogram(np.log10(beta), BETA_EDGES)[0]

        def show(iteration: int, _: object, number: int = number) -> None:
            report((number + (iteration + 1) / config.iterations) / (len(CLIP_RULES) + 0.3))

        _, record = adapt(
            meta, new, config.model_copy(update={"clip": rule()}), seed=seed, on_iteration=show, on_weights=count
        )  # fmt: skip
        iterations.append(pd.DataFrame(record.iterations).assign(rule=name))
        updates.append(pd.DataFrame(record.updates).assign(rule=name, update=np.arange(len(record.updates))))
        histograms.append(
            pd.DataFrame({"rule": name, "log10_beta": BETA_EDGES[:-1], "before": counts[0], "after": counts[1]})
        )
    gradients = gradient_variance(meta, new, config, seed, gradient_batches)
    return {
        "updates": pd.concat(updates, ignore_index=True),
        "iterations": pd.concat(iterations, ignore_index=True),
        "histograms": pd.concat(histograms, ignore_index=True),
        "gradients": gradients,
    }


def gradient_variance(meta: MQL, new: ReplayBuffer, config: AdaptationConfig, seed: int, batches: int) -> pd.DataFrame:
    """How much the critics' gradient differs from batch to batch, at the meta-policy, with β of mean 1 in each batch.

    With that normalisation a rule gains nothing by making all weights smaller. The same batches and target noise for
    every rule; running statistics of a rule go on from batch to batch.

    Returns:
        A row a rule, `uniform` (β = 1) among them: `gradient_variance`, the trace of the covariance of the gradient
        over batches; `gradient_norm2`, the squared norm of its mean; `effective_sample_size`, mean over batches.
    """
    rng = np.random.default_rng(seed)
    noise = torch.Generator(meta.device).manual_seed(seed)
    policy = copy.deepcopy(meta.policy)
    parameters = [*policy.critic.parameters(), *policy.context.parameters()]
    propensity = fit_to(meta, new, config, rng)
    states = {name: rule().start() for name, rule in CLIP_RULES.items()}
    names = ["uniform", *states]
    mean = {name: [torch.zeros_like(p) for p in parameters] for name in names}
    square = dict.fromkeys(names, 0.0)
    size = dict.fromkeys(names, 0.0)
    for _ in range(batches):
        batch = meta.draw(meta.replay_buffer, config.batch_size, rng)
        raw = propensity.beta(features(meta.policy, batch))
        errors = criticise(policy, batch.to(meta.device), meta.td3, noise).errors
        for name in names:
            beta = np.ones_like(raw) if name == "uniform" else states[name].clip(raw)[0]
            weights = torch.as_tensor(beta / beta.mean(), dtype=torch.float32, device=meta.device)
            gradient = torch.autograd.grad((weights * errors).mean(), parameters, retain_graph=True, allow_unused=True)
            for total, each in zip(mean[name], gradient, strict=True):
                if each is not None:
                    total += each / batches
                    square[name] += float(each.square().sum()) / batches
            size[name] += effective_sample_size(beta) / batches
    rows = []
    for name in names:
        norm = float(sum(total.square().sum() for total in mean[name]))
        spread = (square[name] - norm) * batches / (batches - 1)
        rows.append(
            {"rule": name, "gradient_variance": spread, "gradient_norm2": norm, "effective_sample_size": size[name]}
        )
    return pd.DataFrame(rows)
