"""Medians with bootstrap intervals, and the aggregates across scenes of Agarwal et al. (2021).

The aggregates reproduce their library rliable 1.2.0 bit for bit, with the same random draws.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def median_interval(values: Iterable[float]) -> Interval:
    """Median and its percentile-bootstrap interval; NaN without values.

    Args:
        values: (n,) one per episode; with n = 1 the interval is the value itself.
    """
    return _median_interval(tuple(values))


@lru_cache(2048)  # one table repeats columns of another
def _median_interval(values: tuple[float, ...]) -> Interval:
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


def fisher_p(flags: ArrayLike, others: ArrayLike) -> float:
    """Fisher's exact two-sided p of two samples of flags, (n,) and (m,).

    The probability of counts that are no likelier than these, given their sum, if both samples have
    the same share.
    """
    from scipy import stats

    table = [[int(np.sum(of)), int(np.size(of) - np.sum(of))] for of in (flags, others)]
    return float(stats.fisher_exact(table).pvalue)


def rank_correlation(a: ArrayLike, b: ArrayLike) -> float:
    """Spearman's correlation of values (n,) and (n,); NaN if one of them is constant."""
    from scipy import stats

    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(stats.spearmanr(a, b).statistic)


def rank_correlation_interval(a: ArrayLike, b: ArrayLike) -> Interval:
    """Spearman's correlation of values (n,) and (n,), with the bootstrap interval over pairs.

    NaN without values, or if one of them is constant.
    """
    from scipy import stats

    if np.size(a) == 0 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return Interval(np.nan, np.nan, np.nan)

    def spearman(*samples: Float64, axis: int = -1) -> Float64:
        ranks = [stats.rankdata(sample, axis=axis) for sample in samples]
        x, y = (rank - rank.mean(axis=axis, keepdims=True) for rank in ranks)
        scale = np.sqrt((x * x).sum(axis=axis) * (y * y).sum(axis=axis))
        found: Float64 = (x * y).sum(axis=axis) / np.where(scale == 0, 1.0, scale)
        return found

    return bootstrap_interval((a, b), spearman)


def pooled_rank_correlation(groups: Sequence[tuple[ArrayLike, ArrayLike]]) -> Interval:
    """Spearman's correlation over the pairs of all groups, with its bootstrap interval.

    Whole groups are resampled, because the pairs of one are no independent samples.

    Args:
        groups: for each group, values (n,) and (n,).
    """
    pairs = [np.array(group, dtype=np.float64) for group in groups]  # (2, n) each
    if not pairs:
        return Interval(np.nan, np.nan, np.nan)
    value = rank_correlation(*np.concatenate(pairs, axis=1))
    rng = np.random.default_rng(0)
    drawn = [
        rank_correlation(*np.concatenate([pairs[k] for k in which], axis=1))
        for which in rng.integers(len(pairs), size=(_RESAMPLES, len(pairs)))
    ]
    known = [one for one in drawn if np.isfinite(one)]
    if not known:
        return Interval(value, np.nan, np.nan)
    low, high = np.percentile(known, _PERCENTILES)
    return Interval(value, float(low), float(high))


def interquartile_mean(scores: Float64) -> Float64:
    """Mean of the middle half of scores (..., n), (...): rliable's ``aggregate_iqm``."""
    count = scores.shape[-1]
    cut = count // 4
    middle: Float64 = np.sort(scores, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return middle


def interquartile_means(scores: Mapping[str, Float64]) -> dict[str, Interval]:
    """Interquartile mean across scenes and its stratified-bootstrap interval, by planner.

    Args:
        scores: planner to (episodes, scenes).
    """
    rng = np.random.RandomState(0)
    found = {}
    for name, of in scores.items():
        (drawn,) = _stratified_draws([of], rng)
        resampled = np.take_along_axis(of[None], drawn, axis=1).reshape(_RESAMPLES, -1)
        limits = np.percentile(interquartile_mean(resampled), _PERCENTILES)
        found[name] = Interval(*map(float, (interquartile_mean(of.reshape(-1)), *limits)))
    return found


def improvement_matrix(scores: Mapping[str, Float64]) -> dict[tuple[str, str], Interval]:
    """P(one planner scores higher than another), averaged across scenes, for all ordered pairs.

    Equal scores count half, so that both directions of a pair add up to 1. Each resample draws the
    episodes of every planner independently and compares all pairs.

    Args:
        scores: planner to (episodes, scenes); planners may differ in their episodes.
    """
    draws = _stratified_draws(list(scores.values()), np.random.RandomState(0))
    weights = {
        name: (drawn.T[..., None] == np.arange(len(of))).sum(1, dtype=np.float64)
        for (name, of), drawn in zip(scores.items(), draws, strict=True)
    }
    return _improvements({name: of.T for name, of in scores.items()}, weights)


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
    return _improvements(by_scene, weights)


def _improvements(
    scores: Mapping[str, Float64], weights: Mapping[str, Float64]
) -> dict[tuple[str, str], Interval]:
    """P(one planner scores higher than another), all ordered pairs.

    Args:
        scores: planner to (scenes, n).
        weights: how often each resample drew each score, planner to (scenes, resamples, n).
    """
    pairs = {}
    for a, b in combinations(scores, 2):
        order = np.sign(scores[a][:, :, None] - scores[b][:, None])
        won = (weights[a] @ order * weights[b]).sum(axis=(0, 2))
        low, high = np.percentile(0.5 + 0.5 * won / order.size, _PERCENTILES)
        pairs[a, b] = Interval(float(0.5 + 0.5 * order.mean()), float(low), float(high))
    back = {(b, a): Interval(1 - p.value, 1 - p.high, 1 - p.low) for (a, b), p in pairs.items()}
    return {**pairs, **back}


def _hierarchical_weights(
    rng: np.random.Generator, policies: int, episodes: int, scenes: int
) -> Float64:
    """How often each resample drew each episode, (scenes, resamples, policies * episodes)."""
    drawn = rng.multinomial(policies, np.full(policies, 1 / policies), _RESAMPLES)[:, None]
    of_scenes = np.repeat(drawn * episodes, scenes, axis=1)
    counts = rng.multinomial(of_scenes, np.full(episodes, 1 / episodes))
    return counts.reshape(_RESAMPLES, scenes, -1).swapaxes(0, 1).astype(np.float64)


def _stratified_draws(
    scores: Sequence[Float64], rng: np.random.RandomState
) -> list[NDArray[np.int64]]:
    """The episodes of each planner and scene that each resample draws, from rliable's stream.

    Args:
        scores: one array (episodes, scenes) per planner.
        rng: source of the draws.

    Returns:
        One array (resamples, episodes, scenes) per planner.
    """
    drawn = [[rng.choice(len(of), of.shape) for of in scores] for _ in range(_RESAMPLES)]
    return [np.array(of) for of in zip(*drawn, strict=True)]
