"""Window sampling and splits."""

from __future__ import annotations

import numpy as np
import pytest

from playslot_rl.data.windows import sample_windows, split_episodes, spread_windows
from playslot_rl.errors import DataError

STARTS, LENGTHS = [0, 5, 7, 17], [5, 2, 10, 3]


def test_every_valid_start_is_equally_likely() -> None:
    rows = sample_windows(STARTS, LENGTHS, 3, 24_000, np.random.default_rng(0))
    starts, counts = np.unique(rows[:, 0], return_counts=True)
    assert starts.tolist() == [0, 1, 2, 7, 8, 9, 10, 11, 12, 13, 14, 17]
    # 12 starts, 2000 expected of each with a standard deviation of 43.
    assert np.abs(counts - 2000).max() < 200


def test_windows_are_consecutive_and_stay_inside_an_episode() -> None:
    rows = sample_windows(STARTS, LENGTHS, 4, 500, np.random.default_rng(1))
    assert rows.shape == (500, 4)
    assert rows.dtype == np.int64
    assert (np.diff(rows, axis=1) == 1).all()
    episode = np.searchsorted(STARTS, rows, side="right")
    assert (episode == episode[:, :1]).all()


def test_only_the_named_episodes_are_drawn_from() -> None:
    rows = sample_windows(STARTS, LENGTHS, 2, 200, np.random.default_rng(2), episodes=[1, 3])
    assert set(rows[:, 0]) == {5, 17, 18}


def test_the_draw_repeats_with_the_generator() -> None:
    draws = [sample_windows(STARTS, LENGTHS, 2, 9, np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(*draws)


@pytest.mark.parametrize("episodes", [None, [1], []])
def test_windows_longer_than_every_episode_are_refused(episodes: list[int] | None) -> None:
    with pytest.raises(DataError, match="expected at least one of 11"):
        sample_windows(STARTS, LENGTHS, 11, 2, np.random.default_rng(0), episodes=episodes)


def test_spread_windows_are_disjoint_and_cover_the_episodes_evenly() -> None:
    every = spread_windows(STARTS, LENGTHS, 2, 100, [0, 1, 2, 3])
    assert every.tolist() == [[s, s + 1] for s in (0, 2, 5, 7, 9, 11, 13, 15, 17)]
    assert spread_windows(STARTS, LENGTHS, 2, 3, [0, 1, 2, 3])[:, 0].tolist() == [0, 9, 17]
    episodes = np.arange(40)
    rows = spread_windows(episodes * 10, np.full(40, 10), 5, 64, episodes)
    assert len(rows) == 64
    assert set(rows[:, 0] // 10) == set(range(40))
    assert spread_windows(STARTS, LENGTHS, 5, 100, [0, 2])[:, 0].tolist() == [0, 7, 12]


def test_a_split_is_disjoint_complete_and_repeats() -> None:
    training, validation = split_episodes(40, 0.1, seed=5)
    assert len(validation) == 4
    assert sorted([*training, *validation]) == list(range(40))
    assert np.array_equal(split_episodes(40, 0.1, seed=5)[1], validation)
    assert not np.array_equal(split_episodes(40, 0.1, seed=6)[1], validation)


def test_a_split_has_an_episode_that_is_long_enough_on_each_side() -> None:
    for seed in range(30):
        usable = np.random.default_rng(seed).random(14) < 0.3
        for validation in (0.05, 0.5, 0.95):
            training, held_out = split_episodes(14, validation, seed, usable)
            assert (len(np.intersect1d(training, held_out)) == 0) == (usable.sum() >= 2)
            assert (usable[training].any() and usable[held_out].any()) or not usable.any()
            whole = split_episodes(14, validation, seed)
            if usable[whole[0]].any() and usable[whole[1]].any():  # nothing has to change
                assert np.array_equal(held_out, whole[1])


def test_small_splits_keep_one_episode_on_each_side() -> None:
    assert [len(part) for part in split_episodes(2, 0.05, 0)] == [1, 1]
    assert [len(part) for part in split_episodes(1, 0.05, 0)] == [1, 1]
    assert [len(part) for part in split_episodes(5, 0.0, 0)] == [5, 5]
