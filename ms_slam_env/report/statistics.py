"""Medians with bootstrap intervals, and the aggregates across scenes of Agarwal et al. (2021).

The aggregates reproduce their library rliable 1.2.0 bit for bit, with the same random draws.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64

CONFIDENCE = 0.95
_PERCENTILES = (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE))
_RESAMPLES = 2000


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval."""

    value: float
    low: float
    high: float


def median_interval(values: ArrayLike) -> Interval:
    """Median and its percentile-bootstrap interval; NaN without values.

    Args:
        values: (n,) one per episode; with n = 1 the interval is the value itself.
    """
    return bootstrap_interval((values,), lambda x, axis: np.median(x, axis=axis))


def relative_cut(values: ArrayLike, baseline: ArrayLike) -> Interval:
    """Cut of the median against a baseline: 1 - median(values) / median(baseline).

    Episodes with the same scene and seed are resampled together.

    Args:
        values: (n,) one per episode.
        baseline: (n,) values of the baseline for the same episodes in the same order.
    """

    def cut(x: Float64, y: Float64, axis: int) -> Float64:
        return 1 - np.median(x, axis=axis) / np.median(y, axis=axis)

    return bootstrap_interval((values, baseline), cut)


def bootstrap_interval(
    samples: tuple[ArrayLike, ...], statistic: Callable[..., Float64]
) -> Interval:
    """Percentile bootstrap of ``statistic(*samples, axis=...)``, resampled in pairs."""
    from scipy import stats

    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    if arrays[0].size == 0:
        return Interval(np.nan, np.nan, np.nan)
    value = float(statistic(*arrays, axis=-1))
    if arrays[0].size == 1:
        return Interval(value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        result = stats.bootstrap(
            arrays,
            statistic,
            paired=True,
            vectorized=True,
            n_resamples=_RESAMPLES,
            confidence_level=CONFIDENCE,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
    return Interval(value, float(result.low), float(result.high))


def share_interval(flags: ArrayLike) -> Interval:
    """Share of true flags (n,) with its Wilson interval; NaN without flags."""
    from scipy import stats

    array = np.asarray(flags, dtype=bool)
    if array.size == 0:
        return Interval(np.nan, np.nan, np.nan)
    test = stats.binomtest(int(array.sum()), array.size)
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return Interval(float(array.mean()), float(interval.low), float(interval.high))


def rank_correlation(a: ArrayLike, b: ArrayLike) -> float:
    """Spearman's correlation of values (n,) and (n,); NaN if one of them is constant."""
    from scipy import stats

    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(stats.spearmanr(a, b).statistic)


def interquartile_mean(scores: Float64) -> float:
    """Mean of the middle half of scores (episodes, scenes): rliable's ``aggregate_iqm``."""
    ordered = np.sort(scores, axis=None)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def interquartile_means(scores: Mapping[str, Float64]) -> dict[str, Interval]:
    """Interquartile mean across scenes and its stratified-bootstrap interval, by planner.

    Args:
        scores: planner to (episodes, scenes).
    """
    rng = np.random.RandomState(0)
    return {
        name: _stratified_bootstrap([of], lambda x: np.array([interquartile_mean(x)]), rng)[0]
        for name, of in scores.items()
    }


def improvement_matrix(scores: Mapping[str, Float64]) -> dict[tuple[str, str], Interval]:
    """P(one planner scores higher than another), averaged across scenes, for all ordered pairs.

    Equal scores count half, so that both directions of a pair add up to 1. Each resample draws the
    episodes of every planner independently and compares all pairs.

    Args:
        scores: planner to (episodes, scenes); planners may differ in their episodes.
    """

    def of_all(*resampled: Float64) -> Float64:
        by_scene = [np.ascontiguousarray(of.T) for of in resampled]  # long rows are compared faster
        return np.array([_improvement(a, b) for a, b in combinations(by_scene, 2)])

    found = _stratified_bootstrap(list(scores.values()), of_all, np.random.RandomState(0))
    return _both_ways(dict(zip(combinations(scores, 2), found, strict=True)))


def improvement_of_trainings(scores: Mapping[str, Float64]) -> dict[tuple[str, str], Interval]:
    """``improvement_matrix`` of planners with several policies, such as trainings by seed.

    A resample draws policies, and then episodes of each (hierarchical bootstrap), so that the
    intervals include the variation between trainings. With few policies they are slightly too
    narrow, for P policies by a factor of about sqrt(1 - 1/P), as with every bootstrap.

    Args:
        scores: planner to (policies, episodes, scenes).
    """
    rng = np.random.default_rng(0)
    by_scene = {name: of.reshape(-1, of.shape[2]).T for name, of in scores.items()}
    weights = {name: _hierarchical_weights(rng, *of.shape) for name, of in scores.items()}
    pairs = {}
    for a, b in combinations(scores, 2):
        order = np.sign(by_scene[a][:, :, None] - by_scene[b][:, None])
        drawn = np.einsum("rsi,sij,rsj->r", weights[a], order, weights[b], optimize=True)
        low, high = np.percentile(drawn / order.size, _PERCENTILES)
        pairs[a, b] = Interval(*(float(0.5 + 0.5 * of) for of in (order.mean(), low, high)))
    return _both_ways(pairs)


def _hierarchical_weights(
    rng: np.random.Generator, policies: int, episodes: int, scenes: int
) -> Float64:
    """How often each resample drew each episode, (resamples, scenes, policies * episodes)."""
    drawn = rng.multinomial(policies, np.full(policies, 1 / policies), _RESAMPLES)[:, None]
    of_scenes = np.repeat(drawn * episodes, scenes, axis=1)
    counts = rng.multinomial(of_scenes, np.full(episodes, 1 / episodes))
    return counts.reshape(_RESAMPLES, scenes, -1).astype(np.float64)


def _both_ways(pairs: Mapping[tuple[str, str], Interval]) -> dict[tuple[str, str], Interval]:
    """The pairs, and each pair reversed."""
    back = {(b, a): Interval(1 - p.value, 1 - p.high, 1 - p.low) for (a, b), p in pairs.items()}
    return {**pairs, **back}


def _improvement(a: Float64, b: Float64) -> float:
    """rliable's ``probability_of_improvement`` of scores (scenes, m) over (scenes, n)."""
    a, b = a[:, :, None], b[:, None]
    more, less = np.count_nonzero(a > b), np.count_nonzero(a < b)
    return 0.5 + 0.5 * (more - less) / (a.size * b.shape[2])


def _stratified_bootstrap(
    scores: Sequence[Float64],
    aggregate: Callable[..., Float64],
    rng: np.random.RandomState,
) -> list[Interval]:
    """Percentile intervals of the values (k,) that ``aggregate`` computes from ``scores``.

    A resample redraws the episodes of each planner and scene from the same random stream as
    rliable, so that tables made with it do not change.

    Args:
        scores: one array (episodes, scenes) per planner.
        aggregate: function of as many resampled arrays.
        rng: source of the draws.
    """
    drawn = np.array(
        [
            aggregate(*(np.take_along_axis(of, rng.choice(len(of), of.shape), 0) for of in scores))
            for _ in range(_RESAMPLES)
        ]
    )
    limits = np.percentile(drawn, _PERCENTILES, axis=0)
    return [Interval(*map(float, of)) for of in zip(aggregate(*scores), *limits, strict=True)]
