"""Wilson score interval of a success rate (E. B. Wilson, 1927)."""

from __future__ import annotations

import math
from statistics import NormalDist


def wilson(successes: float, trials: int) -> tuple[float, float]:
    """95 % interval of a success probability; unlike the normal one it stays in [0, 1] and is not empty at 0 or 100 %.
    The successes may be a mean over repetitions. A ValueError where a count is outside its range.

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
