"""The first N demonstrations, and the transitions of a data set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from playslot_rl.data.action_limits import ActionLimits
from playslot_rl.data.demonstrations import (
    probed_actions,
    real_actions,
    require_finite,
    require_labelled,
    split_demonstrations,
    transitions,
)
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import concatenate, drawn_demonstrations, first_demonstrations
from playslot_rl.errors import DataError


@pytest.fixture
def source() -> EpisodeFrames:
    """Episodes of 3, 1 and 2 frames."""
    return EpisodeFrames(
        frames=np.arange(72, dtype=np.uint8).reshape(6, 2, 2, 3),
        starts=np.array([0, 3, 4]), lengths=np.array([3, 1, 2]),
        actions=np.arange(12, dtype=np.float32).reshape(6, 2) - 1, seeds=np.array([7, 8, 9]),
        fingerprint="whole", fps=10.0, task="", camera="",
    )  # fmt: skip


def test_the_first_demonstrations_keep_their_rows_and_have_a_name_of_their_own(source: EpisodeFrames) -> None:
    two = first_demonstrations(source, 2)
    assert (two.starts.tolist(), two.lengths.tolist()) == ([0, 3], [3, 1])
    assert two.seeds is not None
    assert two.seeds.tolist() == [7, 8]
    assert len(two.frames) == 6, "the slot cache is indexed by the rows of the whole data set"
    assert len({source.fingerprint, two.fingerprint, first_demonstrations(source, 1).fingerprint}) == 3


def test_all_demonstrations_are_the_data_set_itself(source: EpisodeFrames) -> None:
    assert first_demonstrations(source, None) is source
    assert first_demonstrations(source, 3) is source


def test_too_few_are_refused(source: EpisodeFrames) -> None:
    with pytest.raises(DataError, match="demos: got 4, expected at most the 3 demonstrations"):
        first_demonstrations(source, 4)
    require_labelled(3, 3)
    with pytest.raises(DataError, match=r"behaviour\.labelled_demos: got 4, expected at most the 3"):
        require_labelled(4, 3)


def test_transitions_leave_last_frames_and_single_frames_out(source: EpisodeFrames) -> None:
    moves = transitions(source)
    assert moves.rows.tolist() == [0, 1, 4]
    assert moves.episode.tolist() == [0, 0, 1]
    assert moves.lengths.tolist() == [2, 1]
    with pytest.raises(DataError, match="no episode of two frames"):
        transitions(replace(source, lengths=np.array([1, 1, 1])))


def test_actions_are_clamped_and_of_the_right_width(source: EpisodeFrames) -> None:
    assert real_actions(source, np.array([0, 1]), 2).tolist() == [[-1.0, 0.0], [1.0, 1.0]]
    with pytest.raises(DataError, match="got actions of width 2, expected 4"):
        real_actions(source, np.array([0]), 4)


def test_sets_with_and_without_actions_are_one_whose_first_demonstrations_are_labelled(source: EpisodeFrames) -> None:
    low, high = np.float32([-1, 0]), np.float32([9, 10])
    acted = replace(source, name="acted", limits=ActionLimits(("x", "y"), low, high, low, high))
    silent = replace(source, name="silent", fingerprint="silent", actions=None)
    both = concatenate([acted, silent])
    assert both.actions is not None
    assert both.limits is not None
    assert source.actions is not None
    assert np.array_equal(both.actions[:6], source.actions)
    assert np.isnan(both.actions[6:]).all()
    assert (both.unlabelled, both.limits.low.tolist(), both.limits.high.tolist()) == ("silent", [-1, 0], [9, 10])
    assert "silent" not in both.limits.line(both.actions)
    split = split_demonstrations(both, 5, 0, 1)
    for labelled in (1, 2):
        require_finite(split, labelled)
    probed = probed_actions(both, np.array([0, 6]))
    assert probed is not None
    assert np.isnan(probed).any(axis=1).tolist() == [False, True]
    other = split_demonstrations(concatenate([silent, acted]), 6, 0, 1)
    require_finite(other, 2)  # in whatever order they are named
    for wanted, given in ((3, split), (None, split), (3, other)):
        with pytest.raises(DataError, match=r"^silent: got no actions, expected some .*: 2 have any"):
            require_finite(given, wanted)
    assert concatenate([silent, replace(silent, fingerprint="other")]).actions is None
    wide = replace(acted, fingerprint="wide", actions=np.zeros((6, 3), np.float32))
    assert concatenate([acted, wide]).actions is None


@pytest.mark.parametrize(
    ("demos", "kept", "measured", "expected"),
    [
        (None, 0, 10, (3, 3, None)),  # all are trained on: nothing is beyond them
        (2, 0, 10, (2, 3, [2])),
        (1, 0, 1, (1, 3, [2])),
        (None, 1, 0, (2, 2, [2])),
        (1, 1, 2, (1, 2, [1, 2])),
        (3, 1, 2, (3, 3, None)),
    ],
)
def test_the_last_demonstrations_beyond_those_trained_on_measure(
    source: EpisodeFrames, demos: int | None, kept: int, measured: int, expected: tuple[int, int, list[int] | None]
) -> None:
    split = split_demonstrations(source, demos, kept, measured)
    assert (split.trained.episodes, split.parsed.episodes) == expected[:2]
    if expected[2] is None:
        assert split.held_out is None
        return
    assert split.held_out is not None
    assert split.held_out.episodes == len(expected[2])
    for own, episode in enumerate(expected[2]):
        rows, there = split.held_out.episode_rows(own), source.episode_rows(episode)
        assert np.array_equal(split.held_out.frames[rows], source.frames[there])
        if source.actions is not None and split.held_out.actions is not None:
            assert np.array_equal(split.held_out.actions[rows], source.actions[there])
    assert len({split.held_out.fingerprint, split.trained.fingerprint, source.fingerprint}) == 3


def test_a_draw_changes_who_comes_first_and_nothing_else(source: EpisodeFrames) -> None:
    orders = {tuple(drawn_demonstrations(source, seed).starts.tolist()) for seed in range(20)}
    assert len(orders) > 1
    drawn = drawn_demonstrations(source, 3)
    assert sorted(zip(drawn.starts, drawn.lengths, strict=True)) == [(0, 3), (3, 1), (4, 2)]
    assert drawn.seeds is not None
    assert {int(s): int(n) for s, n in zip(drawn.starts, drawn.seeds, strict=True)} == {0: 7, 3: 8, 4: 9}
    assert drawn.frames is source.frames
    assert (
        drawn_demonstrations(source, 3).fingerprint == drawn.fingerprint != drawn_demonstrations(source, 4).fingerprint
    )


@pytest.mark.parametrize(("episodes", "kept", "measured"), [(150, 0, 10), (155, 10, 10), (160, 10, 10), (12, 0, 10)])
def test_few_demonstrations_of_a_draw_are_the_first_of_many(episodes: int, kept: int, measured: int) -> None:
    """Slot BC's labelled demonstrations are PlaySlot's, which trains on more of them."""
    frames, numbers = np.zeros((2 * episodes, 4, 4, 3), np.uint8), np.arange(episodes)
    source = EpisodeFrames(frames, 2 * numbers, np.full(episodes, 2), None, numbers, "f", 10.0, "", "c")
    orders = set()
    for draw in range(5):
        many = split_demonstrations(source, episodes - 5, kept, measured, draw)
        for demos in (1, 5, episodes - 5):
            few = split_demonstrations(source, demos, kept, measured, draw)
            assert few.trained.starts.tolist() == many.trained.starts[:demos].tolist()
            assert few.held_out is not None
            assert few.held_out.seeds is not None
            assert few.trained.seeds is not None
            assert not {*few.held_out.seeds.tolist()} & {*few.trained.seeds.tolist()}
        assert len({*many.trained.starts.tolist()}) == episodes - 5
        orders.add(tuple(many.trained.starts[:5]))
    assert len(orders) == 5


@pytest.mark.parametrize("kept", [3, 9])
def test_demonstrations_that_are_all_held_out_are_refused(source: EpisodeFrames, kept: int) -> None:
    with pytest.raises(DataError, match=f"data.held_out: got {kept}, expected less than the 3 demonstrations"):
        split_demonstrations(source, None, kept, 0)


@pytest.mark.parametrize("draw", range(6))
def test_what_measures_is_never_drawn(source: EpisodeFrames, draw: int) -> None:
    split = split_demonstrations(source, 1, 1, 0, draw)
    assert split.trained.episodes == 1
    assert int(split.trained.starts[0]) in (0, 3), "the last one measures"
    whole = split_demonstrations(source, None, 0, 10, draw)
    assert sorted(whole.trained.starts.tolist()) == [0, 3, 4]
    assert whole.parsed is source, "the slot cache is in the order of the data set"
