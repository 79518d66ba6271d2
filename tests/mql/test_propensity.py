"""Propensities against known density ratios, clipping against batches worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from outlap.errors import OutlapError
from outlap.mql.propensity import (
    CLIP_RULES,
    AdaptiveBetaClip,
    FixedClip,
    NoClip,
    Propensity,
    effective_sample_size,
    fit_propensity,
)

SHIFT = 0.7  # new task N(0, 1), meta-training N(SHIFT, 1)


def gaussians(n: int, m: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 1.0, (n, 1)), rng.normal(SHIFT, 1.0, (m, 1))


def true_ratio(x: np.ndarray) -> np.ndarray:
    """N(0, 1) over N(SHIFT, 1): exp(-x²/2 + (x - SHIFT)²/2)."""
    return np.exp(-SHIFT * x + SHIFT**2 / 2)


WHERE_THERE_IS_DATA = np.linspace(-1.645, 1.645 + SHIFT, 50)  # 5 % of the one to 95 % of the other


@pytest.mark.parametrize(("n", "m"), [(40_000, 40_000), (50_000, 10_000), (10_000, 50_000)])
def test_beta_is_the_ratio_of_the_densities_however_many_there_are_of_each(n: int, m: int) -> None:
    new, meta = gaussians(n, m)
    fitted = fit_propensity(new, meta, regularization=100.0)
    x = WHERE_THERE_IS_DATA
    np.testing.assert_allclose(fitted.beta(x[:, None]), true_ratio(x), rtol=0.1)
    np.testing.assert_allclose(fitted.log_beta(x[:, None]), np.log(true_ratio(x)), atol=0.1)
    # E[β] = 1 under the meta-training, whose transitions it weighs.
    assert fitted.beta(meta).mean() == pytest.approx(1.0, abs=0.05)
    # The boundary is half way, SHIFT/2 from either mean: Φ(SHIFT / 2) of both sides are right.
    assert fitted.accuracy == pytest.approx(0.5 * (1.0 + math.erf(SHIFT / 2 / math.sqrt(2.0))), abs=0.01)


def test_beta_does_not_depend_on_the_units_of_a_feature() -> None:
    new, meta = gaussians(5000, 5000)
    x = WHERE_THERE_IS_DATA[:, None]
    plain = fit_propensity(new, meta).beta(x)
    scaled = fit_propensity(1e-3 * new + 50.0, 1e-3 * meta + 50.0).beta(1e-3 * x + 50.0)
    np.testing.assert_allclose(scaled, plain, rtol=1e-3)


def test_a_feature_that_never_changes_says_nothing() -> None:
    new, meta = gaussians(2000, 2000)
    x = WHERE_THERE_IS_DATA[:, None]
    plain = fit_propensity(new, meta).beta(x)
    wider = [np.column_stack([values, np.full(len(values), 3.0)]) for values in (new, meta, x)]
    np.testing.assert_allclose(fit_propensity(wider[0], wider[1]).beta(wider[2]), plain, rtol=1e-3)


def test_stronger_regularisation_brings_beta_nearer_to_1() -> None:
    new, meta = gaussians(200, 200)
    slopes = [abs(fit_propensity(new, meta, c).weight[0]) for c in (1e-4, 1e-2, 1.0)]
    assert slopes[0] < 0.1 * slopes[1] < 0.1 * slopes[2]


def test_the_same_samples_on_both_sides_all_weigh_the_same() -> None:
    samples = np.random.default_rng(0).normal(size=(2000, 4))
    fitted = fit_propensity(samples, samples)
    np.testing.assert_allclose(fitted.beta(samples), 1.0, atol=1e-3)
    assert fitted.accuracy == pytest.approx(0.5, abs=0.01)
    assert effective_sample_size(fitted.beta(samples)) == pytest.approx(1.0, abs=1e-5)


def test_samples_of_one_distribution_are_not_told_apart() -> None:
    rng = np.random.default_rng(1)
    new, meta = rng.normal(size=(5000, 3)), rng.normal(size=(8000, 3))
    fitted = fit_propensity(new, meta)
    assert fitted.accuracy == pytest.approx(0.5, abs=0.03)
    ess = effective_sample_size(fitted.beta(meta))
    assert ess > 0.99
    assert 1.0 - ess == pytest.approx(0.0, abs=0.01)  # λ


def test_what_is_like_the_new_task_weighs_more() -> None:
    rng = np.random.default_rng(2)
    new, meta = rng.normal(-2.0, 1.0, (500, 1)), rng.normal(2.0, 1.0, (500, 1))
    fitted = fit_propensity(new, meta)
    assert fitted.beta(new).mean() > 10.0
    assert np.median(fitted.beta(meta)) < 0.1
    assert effective_sample_size(fitted.beta(meta)) < 0.2  # few of the meta-training are like it


def test_beta_is_the_exponential_of_minus_f_of_standardised_features() -> None:
    # f = w·(x - mean)/scale + b: for the first row 2·(3 - 1)/2 - 1·(4 - 0)/4 + 0.5 = 1.5, then -0.5.
    fitted = Propensity(np.array([2.0, -1.0]), 0.5, np.array([1.0, 0.0]), np.array([2.0, 4.0]), 0.5)
    features = np.array([[3.0, 4.0], [1.0, 4.0]])
    np.testing.assert_allclose(fitted.log_beta(features), [-1.5, 0.5])
    np.testing.assert_allclose(fitted.beta(features), [math.exp(-1.5), math.exp(0.5)])


def test_accuracy_counts_both_sides_the_same() -> None:
    rng = np.random.default_rng(3)
    new, meta = rng.normal(0.0, 1.0, (300, 2)), rng.normal(0.4, 1.0, (6000, 2))
    fitted = fit_propensity(new, meta)
    right = (fitted.log_beta(new) > 0).mean(), (fitted.log_beta(meta) < 0).mean()
    assert fitted.accuracy == pytest.approx(sum(right) / 2, abs=1e-9)


FAR = Propensity(np.array([-1.0]), 0.0, np.array([0.0]), np.array([1.0]), 1.0)  # log β = x


def test_beta_stays_finite() -> None:
    beta = FAR.beta(np.array([[1e4], [1e300], [2.0], [-1e4]]))
    assert np.isfinite(beta).all()
    assert beta[0] == beta[1] > 1e10
    assert beta[2] == pytest.approx(math.exp(2.0))
    assert 0.0 < beta[3] < 1e-10  # a batch far from the task still has an effective sample size


def test_beta_squared_and_summed_stays_finite_in_single_precision() -> None:
    beta = FAR.beta(np.full((256, 1), 1e4)).astype(np.float32)
    assert np.isfinite(np.square(beta).sum())


GOOD = np.ones((3, 2))


@pytest.mark.parametrize("bad", [np.zeros((0, 2)), np.array([[1.0, np.nan]]), np.array([[np.inf, 1.0]])])
def test_features_that_are_empty_or_not_finite_are_an_error(bad: np.ndarray) -> None:
    with pytest.raises(OutlapError, match="features of the new task are empty or not finite"):
        fit_propensity(bad, GOOD)
    with pytest.raises(OutlapError, match="features of the meta-training are empty or not finite"):
        fit_propensity(GOOD, bad)


# Effective sample size.

weights = st.floats(1e-6, 1e6) | st.just(0.0)
some_weights = st.lists(weights, min_size=1, max_size=50).filter(any)


def kish(beta: list[float]) -> float:
    return math.fsum(beta) ** 2 / (len(beta) * math.fsum(value**2 for value in beta))


def test_effective_sample_size_by_hand() -> None:
    # 1, 2, 3: 6² / (3 · 14).
    assert effective_sample_size(np.array([1.0, 2.0, 3.0])) == pytest.approx(36 / 42)
    assert effective_sample_size(np.full(7, 0.3)) == pytest.approx(1.0)


@pytest.mark.parametrize("n", [1, 2, 256])
def test_one_weight_alone_is_one_sample_of_n(n: int) -> None:
    assert effective_sample_size(np.eye(n)[n // 2]) == pytest.approx(1 / n)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(some_weights)
def test_effective_sample_size_is_kishs_and_a_share(beta: list[float]) -> None:
    ess = effective_sample_size(np.array(beta))
    assert ess == pytest.approx(kish(beta), rel=1e-9)
    assert 1 / len(beta) * (1 - 1e-9) <= ess <= 1.0 + 1e-9
    assert ess > 0.0


@settings(max_examples=100, deadline=None, derandomize=True)
@given(some_weights, st.floats(1e-20, 1e20))
def test_effective_sample_size_does_not_depend_on_the_scale(beta: list[float], scale: float) -> None:
    expected = effective_sample_size(np.array(beta))
    assert effective_sample_size(scale * np.array(beta)) == pytest.approx(expected, rel=1e-9)


def test_effective_sample_size_of_large_single_precision_weights() -> None:
    assert effective_sample_size(np.full(1000, 1e37, np.float32)) == pytest.approx(1.0)


# Clipping.


def test_no_clip_leaves_the_weights_as_they_are() -> None:
    beta = np.array([0.0, 1.0, 1e20])
    clipped, level = NoClip().start().clip(beta)
    assert clipped.tolist() == [0.0, 1.0, 1e20]
    assert level == math.inf


def test_the_fixed_clip_is_at_the_exponential_of_its_bound() -> None:
    e = math.e
    clipped, level = FixedClip(bound=2.0).start().clip(np.array([0.0, 1.0, e**2 - 1e-9, e**2 + 1e-3, 1e9]))
    assert level == pytest.approx(e**2)
    np.testing.assert_allclose(clipped, [0.0, 1.0, e**2 - 1e-9, e**2, e**2], rtol=1e-12)


def test_the_fixed_clip_does_nothing_to_weights_below_it() -> None:
    beta = np.array([0.0, 0.5, 4.48])  # exp(1.5) is 4.4817
    clipped, level = FixedClip().start().clip(beta)
    assert clipped.tolist() == beta.tolist()
    assert level == pytest.approx(4.4817, abs=1e-4)


# k 2.5, m 0.9. Of ten weights of which one is v and the others 0: mean v/10, standard deviation 0.3 v.
BATCHES = [
    # weights, level, the largest after it
    ([0.0] * 9 + [10.0], 8.5, 8.5),  # μ 1, σ 3; 1 + 2.5·3
    ([0.0] * 9 + [30.0], 10.2, 10.2),  # μ 0.9 + 0.1·3 = 1.2, σ 2.7 + 0.1·9 = 3.6; 1.2 + 2.5·3.6
    ([2.0] * 10, 9.38, 2.0),  # μ 1.08 + 0.1·2 = 1.28, σ 3.24 + 0 = 3.24; 1.28 + 2.5·3.24
]


def run_batches(state) -> None:
    for beta, expected, largest in BATCHES:
        clipped, level = state.clip(np.array(beta))
        assert level == pytest.approx(expected, rel=1e-12)
        np.testing.assert_allclose(clipped, np.minimum(beta, expected), rtol=1e-12)
        assert clipped.max() == pytest.approx(largest)


def test_the_adaptive_clip_by_hand() -> None:
    run_batches(AdaptiveBetaClip(k=2.5, momentum=0.9).start())
    run_batches(AdaptiveBetaClip().start())  # the paper's constants


def test_the_adaptive_clip_with_other_constants() -> None:
    state = AdaptiveBetaClip(k=2.0, momentum=0.5).start()
    levels = [state.clip(np.array(beta))[1] for beta, *_ in BATCHES]
    # 1 + 2·3; μ 0.5 + 1.5, σ 1.5 + 4.5; μ 1 + 1, σ 3 + 0.
    assert levels == pytest.approx([7.0, 14.0, 8.0], rel=1e-12)


def test_the_adaptive_clip_begins_anew_with_every_adaptation() -> None:
    rule = AdaptiveBetaClip()
    run_batches(rule.start())
    run_batches(rule.start())


def test_two_adaptations_at_once_do_not_share_their_statistics() -> None:
    rule = AdaptiveBetaClip()
    one, other = rule.start(), rule.start()
    other.clip(np.full(5, 1000.0))
    for beta, expected, _ in BATCHES:
        assert one.clip(np.array(beta))[1] == pytest.approx(expected, rel=1e-12)
        other.clip(np.full(5, 1000.0))
    assert other.clip(np.full(5, 1000.0))[1] == pytest.approx(1000.0)


@pytest.mark.parametrize("rule", [NoClip(), FixedClip(), AdaptiveBetaClip()])
def test_clipping_leaves_its_input_alone(rule) -> None:
    beta = np.array([0.0] * 20 + [100.0])
    rule.start().clip(beta)
    assert beta.tolist() == [0.0] * 20 + [100.0]


def test_single_precision_weights_are_averaged_in_double() -> None:
    # 2^24 + 1 is no float32: the mean of these, added up in float32, is off.
    beta = np.array([2.0**24] + [1.0] * 9999, np.float32)
    _, level = AdaptiveBetaClip(k=0.0).start().clip(beta)
    assert level == pytest.approx((2.0**24 + 9999) / 10_000, rel=1e-12)


def test_the_rules_have_names() -> None:
    assert {name: rule() for name, rule in CLIP_RULES.items()} == {
        "none": NoClip(),
        "fixed": FixedClip(bound=1.5),
        "abc": AdaptiveBetaClip(k=2.5, momentum=0.9),
    }


batches = st.lists(
    st.lists(st.tuples(st.floats(0.0, 1e6), st.floats(-1e3, 1e3)), min_size=1, max_size=30), min_size=1, max_size=4
)


@pytest.mark.parametrize("rule", [FixedClip(bound=0.5), AdaptiveBetaClip(), AdaptiveBetaClip(k=0.0, momentum=0.5)])
@settings(max_examples=50, deadline=None, derandomize=True)
@given(batches=batches)
def test_the_variance_of_a_clipped_loss_is_bounded_by_its_level(rule, batches: list[list[tuple[float, float]]]) -> None:
    """Var[βℓ] ≤ C² E[ℓ²], whatever the weights and the losses are."""
    state = rule.start()
    for batch in batches:
        beta, loss = np.array(batch).T
        clipped, level = state.clip(beta)
        assert (clipped <= beta).all()
        assert (clipped <= level).all()
        np.testing.assert_array_equal(clipped[beta <= level], beta[beta <= level])
        assert np.var(clipped * loss) <= level**2 * np.mean(loss**2) * (1 + 1e-9)
