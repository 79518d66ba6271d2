"""Constants of the update and of an adaptation; importing them does not import PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Discriminator, Field, Tag

from outlap.config import Config
from outlap.mql.propensity import CLIP_RULES, AdaptiveBetaClip, FixedClip, NoClip


class TD3Config(Config):
    """Constants of TD3 (Fujimoto et al., 2018)."""

    tau: float = Field(default=0.005, gt=0, le=1)  # share of the targets' move towards the networks
    exploration_noise: float = Field(default=0.1, ge=0)  # standard deviation of the noise on actions while learning
    policy_noise: float = Field(default=0.2, ge=0)  # standard deviation of the target action's noise
    noise_clip: float = Field(default=0.5, ge=0)  # largest such noise
    policy_delay: int = Field(default=2, ge=1)  # updates of the critics for one of the actor and the targets
    max_grad_norm: float = Field(default=10.0, gt=0)  # of the critics with the context, and of the actor


def _name_of(rule: Any) -> Any:
    return rule.get("rule") if isinstance(rule, Mapping) else getattr(rule, "rule", rule)


def _known(rule: Any) -> Any:
    name = _name_of(rule)
    if not isinstance(name, str) or name not in CLIP_RULES:
        raise ValueError(f"must be, or have a rule that is, one of {', '.join(CLIP_RULES)}")
    return {"rule": rule} if isinstance(rule, str) else rule


# A callable discriminator, because the base class validates the field `rule` before pydantic could look at it.
ClipConfig = Annotated[
    Annotated[NoClip, Tag("none")] | Annotated[FixedClip, Tag("fixed")] | Annotated[AdaptiveBetaClip, Tag("abc")],
    Discriminator(_name_of),
    BeforeValidator(_known),
]
"""A clip rule; in a file `abc`, or `{rule: abc, k: 2.0}`."""


class AdaptationConfig(Config):
    """Constants of an adaptation; those that the paper leaves out are the original's."""

    iterations: int = Field(default=10, ge=0)
    collect_steps: int = Field(default=100, ge=0)  # of each world of the new task, before every iteration
    on_task_steps: int = Field(default=5, ge=0)  # updates on the new task's transitions alone, β = 1, an iteration
    replay_steps: int = Field(default=30, ge=0)  # then updates on the replay of meta-training, weighted by β
    batch_size: int = Field(default=256, ge=0)
    learning_rate: float = Field(default=1e-4, ge=0)
    clip: ClipConfig = AdaptiveBetaClip()
    regularization: float = Field(default=0.1, ge=0)  # C of the logistic regression
    classifier_size: int = Field(default=2000, ge=0)  # most transitions of either side that it is fitted on
    proximal: float = Field(default=1.0, ge=0)  # factor of the term λ‖θ - θ̂‖², λ = 1 - ESS; 0 leaves it out
    exploration_noise: float = Field(default=TD3Config().exploration_noise, ge=0)  # of the actions that collect
