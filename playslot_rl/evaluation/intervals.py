"""Intervals: of one policy's success over its episodes, and of comparisons, with the seeds of world model and policy.

Outcomes are (W, S, E): world models, policy seeds, episodes or clips, NaN where nothing was measured. A bootstrap draws

    m* = sum c_w c_s c_e y_wse / sum c_w c_s c_e,   c_l ~ multinomial(n_l - 1; 1 / n_l, ...) at each level l
    interval = m + k (q - m),   q the 2.5 and 97.5 % quantiles of m*,   k = t_nu / z
    nu = (sum V_l)^2 / sum V_l^2 / (n_l - 1),   V_l the variance of the means over the units of l, divided by n_l

Levels are drawn across each other, not inside: seed s draws the same demonstrations for every world model, and all
policies play the same episodes (the pigeonhole bootstrap; A. Owen, 2007). n - 1 of n units keep a level's variance
unbiased (P. McCarthy and C. Snowden, 1985), and k is Student's quantile with Satterthwaite's degrees of freedom over
the normal one: three world models are few. What is of a cell alone counts once for each level, so that an interval is
rather too wide than too narrow. A level of one unit is not drawn, and the interval says nothing of it. A difference is
that of the outcomes, cell by cell, so that pairs share world model, seed and episode.
"""

from __future__ import annotations

import functools
import itertools
import math
import re
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Final

import numpy as np
import numpy.typing as npt

Outcomes = npt.NDArray[np.float64]
"""(W, S, E)."""
Interval = tuple[float, float]
DRAWS: Final = 2000
"""B."""
RATE: Final = (0.0, 1.0)
"""Bounds of a success rate."""
APART: Final = (-1.0, 1.0)
"""Those of a difference."""
_TAILS: Final = (0.025, 0.975)


def wilson(successes: float, trials: int) -> Interval:
    """95 % interval of a success probability (E. B. Wilson, 1927); unlike the normal one it stays in [0, 1] and is not
    empty at 0 or 100 %. The successes may be a mean over repetitions. A ValueError where a count is outside its range.

    Example:
        >>> low, high = wilson(9, 10)
        >>> round(low, 3), round(high, 3)
        (0.596, 0.982)
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"wilson: got {successes} of {trials}, expected 0 <= successes <= trials and trials >= 1")
    z = NormalDist().inv_cdf(0.975)
    rate = successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials)) / scale
    # The ends at 0 and at 100 % are exact in theory; rounding would leave 1e-17.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def rate_text(rate: float, ci95: Sequence[float], note: str = "", unit: str = " %") -> str:
    """A rate and its interval.

    Example:
        >>> rate_text(0.97, [0.93, 0.99], "; 2 of 3 seeds")
        '97 % (93 to 99; 2 of 3 seeds)'
    """
    low, high = (100 * end for end in ci95)
    return f"{100 * rate:.0f}{unit} ({low:.0f} to {high:.0f}{note})"


def points_text(difference: float, ci95: Sequence[float]) -> str:
    """A difference of rates in points and its interval, bold where that leaves out 0.

    Example:
        >>> points_text(0.35, [0.28, 0.42]), points_text(-0.01, [-0.2, 0.004])
        ('**+35 (+28 to +42)**', '−1 (−20 to 0)')
    """
    low, high = ci95
    return in_bold([f"{round(100 * number):+d}" for number in (difference, *ci95)], low > 0 or high < 0)


def in_bold(numbers: Sequence[str], bold: bool) -> str:
    """`+3.1 (0 to 6.2)` of a value and the ends of its interval."""
    value, low, high = numbers
    text = re.sub(r"[+-]0(?![.\d])", "0", f"{value} ({low} to {high})").replace("-", "−")
    return f"**{text}**" if bold else text


def newcombe(both: float, first: float, second: float, pairs: int) -> Interval:
    """95 % interval of the difference of two success probabilities on the same episodes: Wilson's intervals of the two,
    squared and added with their correlation (R. Newcombe, 1998, paired data, method 10). `both` succeeded in so many of
    the pairs, the `first` or the `second` alone in others; they may be means over repetitions.

    Example:
        >>> [round(end, 3) for end in newcombe(46, 4, 0, 50)]
        [-0.006, 0.188]
    """
    won, lost = both + first, both + second
    odds = both * (pairs - both - first - second) - first * second
    spread = math.sqrt(max(0.0, won * (pairs - won) * lost * (pairs - lost)))
    alike = (max(odds - pairs / 2, 0.0) if odds > 0 else odds) / spread if spread else 0.0
    (low, high), (other_low, other_high) = wilson(min(won, pairs), pairs), wilson(min(lost, pairs), pairs)
    rate, other = won / pairs, lost / pairs

    def end(mine: float, theirs: float) -> float:
        return math.sqrt(max(0.0, mine * mine - 2 * alike * mine * theirs + theirs * theirs))

    return rate - other - end(rate - low, other_high - other), rate - other + end(high - rate, other - other_low)


def weighted_mean(outcomes: Outcomes, weights: npt.ArrayLike = 1.0) -> float:
    """Mean of what was measured, with weights of shape (E,) or of the outcomes'."""
    there = ~np.isnan(outcomes)
    shares = np.where(there, weights, 0.0)
    return float((np.where(there, outcomes, 0.0) * shares).sum() / shares.sum())


def hierarchical(
    outcomes: Outcomes, bounds: Interval = (-math.inf, math.inf), weights: npt.ArrayLike = 1.0
) -> Interval:
    """95 % interval of the mean outcome, cut to `bounds`; with `weights` (E,), such as the actions of each episode, of
    `weighted_mean`, a ratio whose two sums are drawn together. A ValueError where nothing was measured.

    Example:
        >>> hierarchical(np.ones((3, 5, 20)))
        (1.0, 1.0)
    """
    there = ~np.isnan(outcomes)
    if outcomes.ndim != 3 or not there.any():
        raise ValueError(f"outcomes: got shape {outcomes.shape} with {there.sum()} measured, expected (W, S, E)")
    shares, value = np.where(there, weights, 0.0), weighted_mean(outcomes, weights)
    counts = [_counts(units, level) for level, units in enumerate(outcomes.shape)]
    drawn, weight = _sums(counts, np.where(there, outcomes, 0.0) * shares), _sums(counts, shares)
    return _widened(value, drawn[weight > 0] / weight[weight > 0], _widening([outcomes], weights), bounds)


def resampled(statistic: Callable[[Outcomes], Outcomes], units: int, bounds: Interval) -> Interval:
    """95 % interval of a statistic of some units, two at least, from draws (B, units) of them to (B,), as the bootstrap
    of one level; cut to `bounds`.

    Example:
        >>> resampled(lambda drawn: drawn.sum(axis=1) / drawn.sum(axis=1), 5, (0.0, 2.0))
        (1.0, 1.0)
    """
    drawn, value = statistic(_counts(units, 2)), float(statistic(np.ones((1, units)))[0])
    return _widened(value, drawn[~np.isnan(drawn)], _student(units - 1), bounds)


def of_successes(outcomes: Outcomes) -> Interval:
    """95 % interval of a success rate: Wilson's over the episodes for one policy; for several the bootstrap's, or that
    where it is wider, as with no failure at all.
    """
    there = ~np.isnan(outcomes)
    trials = int(there.any(axis=(0, 1)).sum())
    alone = wilson(float(np.nanmean(outcomes)) * trials, trials)
    if there.any(axis=2).sum() == 1:
        return alone
    low, high = hierarchical(outcomes, RATE)
    return min(low, alone[0]), max(high, alone[1])


def of_differences(outcomes: Outcomes, reference: Outcomes) -> Interval:
    """95 % interval of a difference of success rates on pairs: the bootstrap's, or Newcombe's of as many pairs as there
    are episodes where that is wider, as where few of them differ.
    """
    alone, (low, high) = newcombe(*_pairs(outcomes, reference)), hierarchical(paired(outcomes, reference), APART)
    return min(low, alone[0]), max(high, alone[1])


def _pairs(outcomes: Outcomes, reference: Outcomes) -> tuple[float, float, float, int]:
    """Episodes that both won, or one of them alone, as means over the policies; and how many episodes there are."""
    there, both = ~np.isnan(paired(outcomes, reference)), outcomes * reference
    pairs = int(there.any(axis=(0, 1)).sum())
    parts = (np.where(there, part, np.nan) for part in (both, outcomes - both, reference - both))
    won, first, second = (float(np.nanmean(part)) * pairs for part in parts)
    return won, first, second, pairs


def paired(outcomes: Outcomes, reference: Outcomes) -> Outcomes:
    """Differences of a row's outcomes and a reference's. One world model stands for all of the other's: a method
    without a world model meets each of them.
    """
    return outcomes - reference


def interquartile_mean(scores: npt.ArrayLike, weights: npt.ArrayLike = 1.0) -> float:
    """Mean of the middle half of all scores, tasks and runs together (R. Agarwal and others, 2021): of the quantile
    function Q of the scores with their weights, 2 int Q(u) du from 1/4 to 3/4.

    Note:
        rliable trims `n // 4` scores at each end, which is more than half of them where n is no multiple of 4; here
        the scores at the ends count in part. And there a task with more runs weighs more.

    Example:
        >>> interquartile_mean([0, 1, 2, 3, 4, 5, 6, 100])
        3.5
        >>> round(interquartile_mean([0, 1, 5]), 6)
        1.5
    """
    values = np.asarray(scores, np.float64)
    return float(_middle(values.reshape(1, -1), np.broadcast_to(weights, values.shape).reshape(1, -1))[0])


def _middle(scores: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Interquartile mean (B,) of each row of scores (B, n) with weights (B, n)."""
    order = np.argsort(scores, axis=1)
    scores, weights = np.take_along_axis(scores, order, 1), np.take_along_axis(weights, order, 1)
    ends = weights.cumsum(axis=1) / weights.sum(axis=1, keepdims=True)
    inside = np.diff(ends.clip(0.25, 0.75), axis=1, prepend=0.25)
    mean: npt.NDArray[np.float64] = (inside * scores).sum(axis=1) / inside.sum(axis=1)
    return mean


def over_tasks(tasks: Sequence[Outcomes], seed: int = 0) -> tuple[float, Interval]:
    """Interquartile mean of the runs' rates over tasks, each (W, S, E) with all measured, and its 95 % interval: that
    of draws within each task, widened as `hierarchical`'s, at least Wilson's over the middle half of all episodes.
    Every task weighs the same, and its runs share it.
    """
    drawn, weights = list[npt.NDArray[np.float64]](), list[npt.NDArray[np.float64]]()
    for number, outcomes in enumerate(tasks):
        worlds, seeds, episodes = (_counts(n, seed + 3 * number + level) for level, n in enumerate(outcomes.shape))
        rates = np.einsum("be,wse->bws", episodes, outcomes) / episodes.sum(axis=1)[:, None, None]
        share = worlds[:, :, None] * seeds[:, None, :]
        drawn.append(rates.reshape(DRAWS, -1))
        weights.append((share / share.sum(axis=(1, 2), keepdims=True)).reshape(DRAWS, -1))
    middle = _middle(np.concatenate(drawn, axis=1), np.concatenate(weights, axis=1))
    runs = [outcomes.mean(axis=2).ravel() for outcomes in tasks]
    shares = [np.full(len(task), 1 / len(task)) for task in runs]
    score = interquartile_mean(np.concatenate(runs), np.concatenate(shares))
    trials = max(1, sum(outcomes.shape[2] for outcomes in tasks) // 2)
    alone = wilson(min(score, 1.0) * trials, trials)
    low, high = _widened(score, middle, _widening(tasks), RATE)
    return score, (min(low, alone[0]), max(high, alone[1]))


def apart_over_tasks(tasks: Sequence[tuple[Outcomes, Outcomes]]) -> tuple[float, Interval]:
    """Mean over tasks of the difference of a row's success rate and a reference's on pairs, and its 95 % interval: that
    of draws within each task, widened as `hierarchical`'s, at least Newcombe's of all episodes. Tasks weigh the same.
    """
    drawn, apart = list[npt.NDArray[np.float64]](), [paired(*sides) for sides in tasks]
    for number, outcomes in enumerate(apart):
        draws = [_counts(units, 3 * number + level) for level, units in enumerate(outcomes.shape)]
        there = ~np.isnan(outcomes)
        sums, whole = _sums(draws, np.where(there, outcomes, 0.0)), _sums(draws, there.astype(np.float64))
        drawn.append(sums / np.where(whole > 0, whole, np.nan))
    means, value = np.mean(drawn, axis=0), float(np.mean([weighted_mean(one) for one in apart]))
    low, high = _widened(value, means[~np.isnan(means)], _widening(apart), APART)
    counts = [_pairs(*sides) for sides in tasks]
    pairs = sum(of for *_, of in counts)
    shares = [[pairs / len(tasks) * part / of for part in parts] for *parts, of in counts]  # as if all had as many
    won, first, second = (sum(part) for part in zip(*shares, strict=True))
    alone = newcombe(won, first, second, pairs)
    return value, (min(low, alone[0]), max(high, alone[1]))


@functools.lru_cache(maxsize=32)
def _counts(units: int, seed: int) -> npt.NDArray[np.float64]:
    """How often each unit of a level is drawn (B, units); a level of one is always there."""
    if units == 1:
        return np.ones((DRAWS, 1))
    return np.random.default_rng(seed).multinomial(units - 1, np.full(units, 1 / units), DRAWS).astype(np.float64)


def _sums(counts: Sequence[npt.NDArray[np.float64]], values: Outcomes) -> npt.NDArray[np.float64]:
    worlds, seeds, episodes = counts
    drawn = values.reshape(-1, values.shape[2]) @ episodes.T  # (W S, B)
    sums: npt.NDArray[np.float64] = np.einsum("bw,bs,wsb->b", worlds, seeds, drawn.reshape(*values.shape[:2], -1))
    return sums


def _widening(tasks: Sequence[Outcomes], weights: npt.ArrayLike = 1.0) -> float:
    """`_student` at the degrees of freedom that the levels together have, of all tasks."""
    shares, spent = [], []
    for outcomes, level in itertools.product(tasks, range(3)):
        others = tuple({0, 1, 2} - {level})
        weight = np.where(np.isnan(outcomes), 0.0, weights)
        sums, whole = np.nansum(outcomes * weight, axis=others), weight.sum(axis=others)
        means = sums[whole > 0] / whole[whole > 0]
        if len(means) > 1:
            shares.append(float(means.var(ddof=1)) / len(means))
            spent.append(shares[-1] ** 2 / (len(means) - 1))
    if sum(spent) == 0:
        return 1.0
    return _student(sum(shares) ** 2 / sum(spent))


def _student(freedom: float) -> float:
    """Student's quantile over the normal one."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, _TAILS[1])) / NormalDist().inv_cdf(_TAILS[1])


def _widened(value: float, drawn: Outcomes, wider: float, bounds: Interval) -> Interval:
    """The bootstrap's interval from draws (B,), its ends so many times as far from the value, cut to `bounds`."""
    low, high = (value + wider * (float(end) - value) for end in np.quantile(drawn, _TAILS))
    return max(bounds[0], low), min(bounds[1], high)
