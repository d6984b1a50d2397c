"""Statistics against closed forms and direct computation."""

from __future__ import annotations

from dataclasses import astuple
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from ms_slam_env.report import statistics
from ms_slam_env.report.statistics import Interval, pooled_rank_correlation

SCORES = st.floats(-1e3, 1e3)


def test_median_interval_has_the_coverage_of_order_statistics() -> None:
    """The exact interval of the median of 400 values is between the 180th and the 220th."""
    values = np.arange(400.0)
    interval = statistics.median_interval(values)
    low, high = stats.binom.ppf([0.025, 0.975], 400, 0.5)
    assert interval.value == 199.5
    assert interval.low == pytest.approx(values[int(low)], abs=1)
    assert interval.high == pytest.approx(values[int(high) - 1], abs=1)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=12))
def test_interval_holds_the_median_and_lies_in_the_range(values: list[float]) -> None:
    interval = statistics.median_interval(values)
    assert interval.value == np.median(values)
    assert min(values) <= interval.low <= interval.value <= interval.high <= max(values)


def test_one_value_is_its_own_interval() -> None:
    assert statistics.median_interval([3.0]) == Interval(3.0, 3.0, 3.0)


def test_equal_values_have_no_spread() -> None:
    assert statistics.median_interval([2.0] * 8) == Interval(2.0, 2.0, 2.0)


def test_no_values_give_nan() -> None:
    assert np.isnan(statistics.median_interval([]).value)
    assert np.isnan(statistics.share_interval([]).value)


def test_same_values_same_interval() -> None:
    values = np.random.default_rng(3).normal(size=20)
    assert statistics.median_interval(values) == statistics.median_interval(values)


def test_share_interval_is_wilsons() -> None:
    k, n, z = 3, 20, stats.norm.ppf(0.975)
    p = k / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    interval = statistics.share_interval([True] * k + [False] * (n - k))
    assert interval.value == p
    assert (interval.low, interval.high) == pytest.approx((centre - half, centre + half))


def test_cut_of_a_constant_factor_has_no_uncertainty() -> None:
    """Resampled in pairs, values that are 0.6 times the baseline are cut by 0.4, always."""
    baseline = np.random.default_rng(0).lognormal(size=15)
    cut = statistics.relative_cut(0.6 * baseline, baseline)
    assert (cut.value, cut.low, cut.high) == pytest.approx((0.4, 0.4, 0.4))


def test_cut_is_negative_where_the_error_grew() -> None:
    cut = statistics.relative_cut([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    assert cut.value == -1


def test_interquartile_mean_is_the_mean_of_the_middle_half() -> None:
    scores = np.random.default_rng(0).permutation(np.arange(16.0)).reshape(8, 2)
    interval = statistics.interquartile_means({"a": scores})["a"]
    assert interval.value == np.arange(4, 12).mean()
    assert interval.low < interval.value < interval.high


def test_improvement_probability_is_mann_whitneys_and_adds_up_to_one() -> None:
    rng = np.random.default_rng(0)
    a, b = np.round(rng.normal(0.3, 1, (6, 3))), np.round(rng.normal(0, 1, (5, 3)))  # ties
    result = statistics.improvement_matrix({"a": a, "b": b})
    assert set(result) == {("a", "b"), ("b", "a")}
    there, back = result["a", "b"], result["b", "a"]
    assert there.value == pytest.approx(np.mean(stats.mannwhitneyu(a, b).statistic) / 30)
    assert (there.value + back.value, there.low + back.high) == pytest.approx((1, 1))
    assert there.low < there.value < there.high


@given(arrays(np.float64, st.tuples(st.integers(1, 9), st.integers(1, 4)), elements=SCORES))
def test_interquartile_mean_is_a_trimmed_mean(scores: np.ndarray) -> None:
    expected = stats.trim_mean(scores, 0.25, axis=None)
    assert statistics.interquartile_mean(scores.reshape(-1)) == pytest.approx(expected, abs=1e-9)


def test_aggregates_are_rliables() -> None:
    """The numbers are of rliable 1.2.0 with arch 7.2.0, 2,000 resamples, ``np.random.seed(0)``."""
    rng = np.random.default_rng(2)
    scores = {name: np.round(rng.normal(k / 3, 1, (20 + k, 3)), 1) for k, name in enumerate("abcd")}
    means = {name: astuple(of) for name, of in statistics.interquartile_means(scores).items()}
    assert means["a"] == pytest.approx((0.11333333333333334, -0.18, 0.3766666666666667))
    assert means["d"] == pytest.approx((0.9885714285714287, 0.6513571428571431, 1.2915))
    for a, b, expected in (
        ("a", "d", (0.2855072463768116, 0.20107789855072467, 0.3771829710144928)),
        ("c", "b", (0.5927128427128427, 0.4917027417027417, 0.687238455988456)),
    ):
        pair = statistics.improvement_matrix({a: scores[a], b: scores[b]})
        assert astuple(pair[a, b]) == pytest.approx(expected)
    found = statistics.improvement_matrix(scores)  # of all at once, with other draws
    assert set(found) == set(permutations(scores, 2))
    assert astuple(found["a", "d"]) == pytest.approx((0.28551, 0.20108, 0.37718), abs=0.02)


def test_of_one_policy_each_the_episodes_alone_are_resampled() -> None:
    rng = np.random.default_rng(3)
    scores = {name: np.round(rng.normal(k / 3, 1, (20, 3)), 1) for k, name in enumerate("abc")}
    found = statistics.improvement_of_trainings({name: of[None] for name, of in scores.items()})
    theirs = statistics.improvement_matrix(scores)
    assert set(found) == set(theirs)
    for pair, of in theirs.items():
        assert found[pair].value == pytest.approx(of.value)
        assert (found[pair].low, found[pair].high) == pytest.approx((of.low, of.high), abs=0.02)


@given(st.integers(2, 20), st.data())
def test_policies_are_resampled_as_a_binomial_distribution_says(
    policies: int, data: st.DataObject
) -> None:
    """Each policy is better in all episodes or worse: how many better ones are drawn is left."""
    better = data.draw(st.integers(0, policies))
    ours = np.repeat(np.arange(policies)[:, None, None] < better, 4, axis=1).repeat(3, axis=2)
    scores = {"ours": ours.astype(float), "theirs": np.full((1, 5, 3), 0.5)}
    found = statistics.improvement_of_trainings(scores)["ours", "theirs"]
    expected = stats.binom.ppf([0.025, 0.975], policies, better / policies) / policies
    assert found.value == pytest.approx(better / policies)
    assert (found.low, found.high) == pytest.approx(expected, abs=1 / policies + 1e-9)


def test_a_correlation_over_groups_resamples_whole_groups() -> None:
    rng = np.random.default_rng(3)
    values = [(rng.normal(size=5), rng.normal(size=5)) for _ in range(8)]
    found = pooled_rank_correlation(values)
    a, b = (np.concatenate(part) for part in zip(*values, strict=True))
    assert found.value == pytest.approx(stats.spearmanr(a, b).statistic)
    assert found.low < found.value < found.high
    # Copies of one pair in each group add no information, but would to a bootstrap over pairs.
    copies = pooled_rank_correlation(
        [(np.repeat(x[:1], 9), np.repeat(y[:1], 9)) for x, y in values]
    )
    single = pooled_rank_correlation([(x[:1], y[:1]) for x, y in values])
    assert (copies.low, copies.high) == pytest.approx((single.low, single.high))
    assert np.isnan(pooled_rank_correlation([]).value)


def test_fishers_test_is_the_sum_of_no_likelier_tables() -> None:
    for a, b in ((2, 10), (5, 7), (4, 9), (0, 0)):
        of = stats.hypergeom(20, a + b, 10)
        chances = of.pmf(np.arange(11))
        expected = chances[chances <= of.pmf(a) * (1 + 1e-9)].sum()
        flags = [np.arange(10) < count for count in (a, b)]
        assert statistics.fisher_p(*flags) == pytest.approx(expected)


def test_a_rank_correlation_and_its_interval_are_scipys() -> None:
    rng = np.random.default_rng(5)
    a = rng.integers(0, 9, 40).astype(float)  # with ties
    b = a + rng.normal(scale=3, size=40)
    found = statistics.rank_correlation_interval(a, b)
    assert found.value == pytest.approx(stats.spearmanr(a, b).statistic)
    expected = stats.bootstrap(
        (a, b), lambda x, y: stats.spearmanr(x, y).statistic, paired=True, vectorized=False,
        n_resamples=999, method="percentile", rng=np.random.default_rng(1),
    ).confidence_interval  # fmt: skip
    assert (found.low, found.high) == pytest.approx(tuple(expected), abs=0.06)
    assert np.isnan(statistics.rank_correlation_interval([1, 1, 1], [1, 2, 3]).value)
