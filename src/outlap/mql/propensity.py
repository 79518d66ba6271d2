"""How likely a transition of the meta-training is under a new task: propensity β, its clipping, sample size.

A logistic regression f(x) = w·x + b tells meta-training (+1) from the new task (-1); β(x) = exp(-f(x)) is then
P(new task | x) / P(meta-training | x) (Fakoor et al., 2020, section 3.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from pydantic import Field

from outlap.config import Config
from outlap.errors import OutlapError

LARGEST_EXPONENT = 30.0  # β stays finite in float32, squared and summed


@dataclass(frozen=True)
class Propensity:
    """A fitted classifier of context features."""

    weight: np.ndarray  # (features,) of standardised features
    bias: float
    mean: np.ndarray  # (features,)
    scale: np.ndarray  # (features,)
    accuracy: float  # balanced, on what it was fitted to: 0.5 where the two cannot be told apart

    def log_beta(self, features: np.ndarray) -> np.ndarray:
        """-f(x), (n,), of features (n, size)."""
        return -(((features - self.mean) / self.scale) @ self.weight + self.bias)

    def beta(self, features: np.ndarray) -> np.ndarray:
        """exp(-f(x)), (n,), unclipped but for float32's sake."""
        return np.exp(np.clip(self.log_beta(features), -LARGEST_EXPONENT, LARGEST_EXPONENT))


def fit_propensity(new: np.ndarray, meta: np.ndarray, regularization: float = 0.1) -> Propensity:
    """Fit the classifier on features of the new task (n, size) and of the meta-training (m, size).

    Both sides weigh the same, however many there are of each, so that β is a ratio of densities and not of counts.

    Args:
        new, meta: features.
        regularization: scikit-learn's C, the inverse of the strength; 0.05 to 0.5 in the original.

    Raises OutlapError where a side is empty or a feature is not finite.
    """
    from sklearn.linear_model import LogisticRegression

    for name, features in (("new task", new), ("meta-training", meta)):
        if len(features) == 0 or not np.isfinite(features).all():
            raise OutlapError(f"propensity: the features of the {name} are empty or not finite")
    both = np.concatenate([new, meta]).astype(np.float64)
    mean, scale = both.mean(0), both.std(0)
    scale = np.where(scale > 1e-8, scale, 1.0)
    labels = np.concatenate([-np.ones(len(new)), np.ones(len(meta))])
    model = LogisticRegression(C=regularization, class_weight="balanced", max_iter=1000)
    guess = np.array(model.fit((both - mean) / scale, labels).predict((both - mean) / scale)).reshape(-1)
    right = np.equal(guess, labels)
    accuracy = 0.5 * (np.mean(right[: len(new)]) + np.mean(right[len(new) :]))
    return Propensity(np.array(model.coef_)[0], float(np.array(model.intercept_)[0]), mean, scale, float(accuracy))


def effective_sample_size(beta: np.ndarray) -> float:
    """(Σβ)² / (n Σβ²), in (0, 1]: 1 where all weigh the same (Kish, 1965)."""
    beta = np.asarray(beta, np.float64)
    beta = beta / beta.max()
    return float(beta.sum() ** 2 / (len(beta) * np.square(beta).sum()))


class ClipState(Protocol):
    """Limits the weights of one minibatch after the other during one adaptation."""

    def clip(self, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the clipped weights (n,), and the level that they were clipped at; infinity where nothing is."""
        ...


class NoClip(Config):
    """Weights as they are."""

    rule: Literal["none"] = "none"

    def start(self) -> NoClip:
        return self

    def clip(self, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """See `ClipState`."""
        return beta, math.inf


class FixedClip(Config):
    """The original's: f ≥ -bound, so that β ≤ exp(bound)."""

    rule: Literal["fixed"] = "fixed"
    bound: float = Field(default=1.5, ge=0)

    def start(self) -> FixedClip:
        return self

    def clip(self, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """See `ClipState`."""
        level = math.exp(self.bound)
        return np.minimum(beta, level), level


class AdaptiveBetaClip(Config):
    """The paper's ABC: β ≤ μ_t + k σ_t, running mean and standard deviation over minibatches.

    μ_t = m μ_{t-1} + (1 - m) μ_b, and σ_t likewise; the first minibatch begins them.
    """

    rule: Literal["abc"] = "abc"
    k: float = Field(default=2.5, ge=0)
    momentum: float = Field(default=0.9, ge=0)

    def start(self) -> AdaptiveBetaClipState:
        return AdaptiveBetaClipState(self)


class AdaptiveBetaClipState:
    """The running statistics of one adaptation."""

    def __init__(self, rule: AdaptiveBetaClip) -> None:
        self.rule = rule
        self.mean: float | None = None
        self.sd = 0.0

    def clip(self, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """See `ClipState`."""
        mean, sd = float(np.mean(beta, dtype=np.float64)), float(np.std(beta, dtype=np.float64))
        m = 0.0 if self.mean is None else self.rule.momentum
        self.mean = m * (self.mean or 0.0) + (1.0 - m) * mean
        self.sd = m * self.sd + (1.0 - m) * sd
        level = self.mean + self.rule.k * self.sd
        return np.minimum(beta, level), level


CLIP_RULES: dict[str, type[NoClip] | type[FixedClip] | type[AdaptiveBetaClip]] = {
    "none": NoClip,
    "fixed": FixedClip,
    "abc": AdaptiveBetaClip,
}
