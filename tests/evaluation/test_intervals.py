"""Wilson intervals."""

from __future__ import annotations

import pytest

from playslot_rl.evaluation.success import wilson


def test_interval_equals_published_values() -> None:
    # Newcombe (1998), Table I, method 3: 81 of 263, and 0 of 20.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)


def test_interval_is_symmetric_and_narrows_with_more_trials() -> None:
    low, high = wilson(7, 40)
    assert wilson(33, 40) == pytest.approx((1 - high, 1 - low))
    assert wilson(70, 400)[1] - wilson(70, 400)[0] < high - low


def test_interval_at_the_ends_is_exact_and_not_empty() -> None:
    assert wilson(0, 50)[0] == 0.0 < wilson(0, 50)[1]
    assert wilson(50, 50)[0] < wilson(50, 50)[1] == 1.0


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 2), (0, 0)])
def test_impossible_counts_are_refused(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="wilson: got"):
        wilson(successes, trials)
