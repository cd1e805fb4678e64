"""Intervals of one policy and of comparisons, on known values and on simulated outcomes."""

from __future__ import annotations

import numpy as np
import pytest

from playslot_rl.evaluation.intervals import (
    RATE,
    Outcomes,
    apart_over_tasks,
    hierarchical,
    interquartile_mean,
    newcombe,
    of_differences,
    of_successes,
    over_tasks,
    paired,
    resampled,
    weighted_mean,
    wilson,
)


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


def simulated(
    draws: np.random.Generator, shape: tuple[int, int, int], world: float, seed: float, episode: float
) -> Outcomes:
    """Successes of policies whose chances differ by world model, seed and episode, with these standard deviations."""
    worlds, seeds, episodes = shape
    chance = 0.6 + draws.normal(0, world, (worlds, 1, 1)) + draws.normal(0, seed, (1, seeds, 1))
    chance = chance + draws.uniform(-1, 1, (1, 1, episodes)) * episode * 3**0.5
    return (draws.random(shape) < chance.clip(0, 1)).astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "seed", "episode"), [(0.06, 0.04, 0.2), (0.12, 0.0, 0.1), (0.0, 0.08, 0.2), (0.0, 0.0, 0.2)]
)
def test_the_interval_holds_the_true_rate_as_often_as_it_says(world: float, seed: float, episode: float) -> None:
    draws = np.random.default_rng(1)
    held, pooled = 0, 0
    for _ in range(300):
        outcomes = simulated(draws, (3, 5, 100), world, seed, episode)
        low, high = hierarchical(outcomes, RATE)
        held += low <= 0.6 <= high
        low, high = wilson(outcomes.sum(), outcomes.size)
        pooled += low <= 0.6 <= high
    assert 0.93 <= held / 300 <= 1.0
    assert pooled / 300 < 0.8, "outcomes that share world models, seeds and episodes are not independent"


@pytest.mark.slow
def test_the_difference_of_rows_that_share_everything_but_luck_holds_0_and_is_narrower_than_its_rows() -> None:
    draws, held, widths = np.random.default_rng(2), 0, np.zeros(2)
    for _ in range(200):
        worlds, seeds, episodes = draws.uniform(0.4, 1, (3, 1, 1)), draws.uniform(0.5, 1, (1, 5, 1)), draws.random(100)
        ease = worlds * seeds * episodes
        first, second = ((draws.random(ease.shape) < ease).astype(np.float64) for _ in range(2))
        low, high = hierarchical(paired(first, second))
        held += low <= 0 <= high
        widths += np.array([high - low, np.subtract(*hierarchical(first)[::-1])])
    assert widths[0] < 0.7 * widths[1]
    assert held / 200 >= 0.93


def test_the_difference_of_identical_rows_is_exactly_0() -> None:
    outcomes = simulated(np.random.default_rng(0), (3, 5, 40), 0.1, 0.1, 0.1)
    assert hierarchical(paired(outcomes, outcomes)) == (0.0, 0.0)


def test_the_interval_of_a_paired_difference_equals_published_values() -> None:
    # Newcombe (1998), Statistics in Medicine 17, 2635, Table IV, method 10: a, b, c, d of 50 pairs.
    assert newcombe(36, 12, 2, 50) == pytest.approx((0.0569, 0.3404), abs=5e-5)
    assert newcombe(1, 2, 3, 10) == pytest.approx([-end for end in newcombe(1, 3, 2, 10)[::-1]])


@pytest.mark.parametrize(("more", "clear"), [(0, False), (1, False), (4, False), (6, True)])
def test_few_pairs_that_differ_are_no_difference(more: int, clear: bool) -> None:
    """As McNemar's exact test has it: p is 0.125 for 4 against 0, 0.031 for 6."""
    won = np.ones((1, 1, 50))
    low, high = of_differences(won, won - (np.arange(50) < more))
    assert (low > 0) is clear
    assert low < more / 50 < high
    assert of_differences(won - (np.arange(50) < more), won) == pytest.approx((-high, -low))


def test_differences_over_seeds_are_never_of_no_width_and_hold_the_bootstraps() -> None:
    same = of_differences(np.ones((1, 3, 50)), np.ones((1, 3, 50)))
    assert same == newcombe(50, 0, 0, 50)
    assert same[1] > 0.05
    first, second = (simulated(np.random.default_rng(n), (2, 3, 20), 0.1, 0.1, 0.1) for n in range(2))
    second[1, 2] = np.nan
    low, high = of_differences(first, second)
    bootstrap = hierarchical(first - second, (-1.0, 1.0))
    assert low <= bootstrap[0] < bootstrap[1] <= high


@pytest.mark.parametrize("errors", [np.full(8, 0.1), np.array([2.0, 1, 3, 1, 1, 2, 1, 1])])
def test_a_weighted_mean_is_a_ratio_whose_sums_are_drawn_together(errors: Outcomes) -> None:
    actions = np.array([20.0, 20, 20, 200, 200, 25, 22, 180])
    ratio = resampled(lambda drawn: drawn @ (actions * errors) / (drawn @ actions), 8, (0.0, np.inf))
    assert hierarchical(errors[None, None], (0.0, np.inf), actions) == pytest.approx(ratio)
    twice = hierarchical(errors[None, None], (0.0, np.inf), 2 * actions)
    assert twice == pytest.approx(ratio)


def test_a_row_without_world_models_is_paired_with_each_of_the_others() -> None:
    outcomes = simulated(np.random.default_rng(0), (3, 5, 40), 0.1, 0.1, 0.1)
    alone = outcomes[:1] * 0
    assert np.array_equal(paired(outcomes, alone), outcomes)


def test_a_level_of_one_unit_is_not_drawn_and_more_world_models_that_differ_widen_the_interval() -> None:
    episodes = (np.arange(100) % 2).astype(np.float64)
    one = np.broadcast_to(episodes, (1, 1, 100))
    assert hierarchical(one, RATE) == pytest.approx(wilson(50, 100), abs=0.015)
    apart = np.stack([np.broadcast_to(episodes < limit, (1, 100)) for limit in (0.5, 0.5, 2)]).astype(np.float64)
    low, high = hierarchical(apart, RATE)
    assert high - low > 0.5


def test_what_was_not_measured_is_left_out() -> None:
    outcomes = simulated(np.random.default_rng(0), (2, 3, 40), 0.0, 0.0, 0.1)
    padded = np.concatenate([outcomes, np.full((2, 1, 40), np.nan)], axis=1)
    low, high = hierarchical(padded, RATE)
    assert low < outcomes.mean() < high
    with pytest.raises(ValueError, match="outcomes: got shape"):
        hierarchical(np.full((1, 1, 2), np.nan))


def test_one_policy_has_wilsons_interval() -> None:
    outcomes = (np.arange(10) < 4).astype(np.float64)[None, None]
    assert of_successes(outcomes) == wilson(4, 10)


def test_no_failure_leaves_what_wilson_leaves() -> None:
    assert of_successes(np.ones((1, 3, 50))) == wilson(50, 50)
    assert of_successes(np.zeros((3, 1, 50))) == wilson(0, 50)


def test_the_interquartile_mean_is_scipys_where_quarters_are_whole() -> None:
    from scipy.stats import trim_mean

    scores = np.random.default_rng(0).random((4, 7))
    assert interquartile_mean(scores) == pytest.approx(trim_mean(scores, 0.25, axis=None))


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7])
def test_the_interquartile_mean_is_of_exactly_half_of_the_scores(count: int) -> None:
    scores = np.random.default_rng(count).random(count)
    fourfold = np.repeat(scores, 4)
    assert interquartile_mean(scores) == pytest.approx(interquartile_mean(fourfold))
    assert interquartile_mean(scores, scores + 1) == pytest.approx(
        interquartile_mean(fourfold, np.repeat(scores + 1, 4))
    )


def test_every_task_weighs_the_same_however_many_runs_it_has() -> None:
    """Runs that are alike within a task leave nothing to draw: the draws are of the score, and Wilson's is left."""
    rates = (0.0, 0.5, 1.0)
    shapes = ((1, 1), (3, 5), (1, 2))
    tasks = [
        np.broadcast_to(np.arange(20) < rate * 20, (*shape, 20)).astype(np.float64)
        for rate, shape in zip(rates, shapes, strict=True)
    ]
    for alike in (tasks, [tasks[0], *tasks[2:]], [tasks[2], tasks[2], tasks[0]]):
        score, interval = over_tasks(alike)
        assert score == pytest.approx(interquartile_mean([task.mean() for task in alike]))
        if all(task.mean() in (0, 1) for task in alike):
            trials = len(alike) * 20 // 2
            assert interval == pytest.approx(wilson(score * trials, trials))


def test_over_tasks_all_won_leaves_what_wilson_leaves_over_half_of_the_episodes() -> None:
    easy, hard = np.ones((3, 5, 20)), np.zeros((3, 5, 20))
    assert over_tasks([easy, easy]) == (1.0, wilson(20, 20))
    mean, (low, high) = over_tasks([easy, hard])
    assert mean == pytest.approx(0.5)
    assert low < mean < high
    mixed = simulated(np.random.default_rng(0), (3, 5, 20), 0.1, 0.1, 0.1)
    mean, (low, high) = over_tasks([mixed, mixed])
    assert low < mean < high


def test_two_seeds_widen_the_interval_over_tasks_as_that_of_one_task() -> None:
    apart = np.stack([np.arange(400) % 10 < tenths for tenths in (5, 6)])[None].astype(np.float64)
    alone = of_successes(apart)
    assert over_tasks([apart])[1] == pytest.approx(alone, abs=0.1)
    assert alone[1] - alone[0] > 0.5


def test_the_difference_over_tasks_is_that_of_one_where_there_is_one() -> None:
    draws = np.random.default_rng(0)
    first, second = ((draws.random((3, 5, 20)) < chance).astype(np.float64) for chance in (0.8, 0.5))
    second[0, 1] = np.nan  # a run that is missing
    value, interval = apart_over_tasks([(first, second)])
    assert value == pytest.approx(weighted_mean(paired(first, second)))
    assert interval == pytest.approx(of_differences(first, second))
    both, narrower = apart_over_tasks([(first, second), (second, first)])
    assert both == pytest.approx(0, abs=1e-12), "tasks weigh the same"
    assert narrower[0] < 0 < narrower[1]
    even = np.ones((1, 2, 10))
    few = np.ones((1, 1, 5))
    value, (low, high) = apart_over_tasks([(np.ones((1, 1, 50)), np.ones((1, 1, 50))), (few, 0 * few)])
    assert low < value == 0.5 < high, "however many episodes a task has"
    low, high = apart_over_tasks([(even, even)] * 3)[1]
    assert -0.2 < low < 0 < high < 0.2, "as Newcombe's of thirty pairs that are alike"


@pytest.mark.slow
def test_the_interval_over_tasks_holds_the_true_score_as_often_as_it_says() -> None:
    draws, held = np.random.default_rng(3), 0
    chances = np.linspace(0.2, 0.9, 6)
    for _ in range(200):
        tasks = [(draws.random((1, 3, 50)) < chance).astype(np.float64) for chance in chances]
        low, high = over_tasks(tasks)[1]
        held += low <= interquartile_mean(chances) <= high
    assert held / 200 >= 0.93
