"""Displacements, agreement, constancy and locality where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.evaluation.effects import (
    Drawn,
    Replayed,
    Windows,
    agreement,
    centroids,
    change_in,
    displacements,
    explained_by_group,
    moving_slots,
    same_mover,
    squared_change,
    transfer_lines,
)


def square(x: int, y: int) -> np.ndarray:
    labels = np.zeros((32, 32), np.int64)
    labels[y : y + 4, x : x + 4] = 1
    return labels


def test_a_square_moves_by_what_it_was_moved_and_empty_slots_do_not() -> None:
    before, after = square(3, 5)[None], square(9, 2)[None]
    where, share = centroids(before, 3)
    assert where[0, 1].tolist() == [4.5, 6.5]
    assert np.isnan(where[0, 2]).all()
    assert share[0].tolist() == [1 - 16 / 1024, 16 / 1024, 0.0]
    moved = displacements(before, after, 3)
    assert moved[0, 1].tolist() == [6.0, -3.0]
    assert moved[0, 2].tolist() == [0.0, 0.0]


def test_a_slot_that_moves_is_told_from_the_ground_it_uncovers() -> None:
    ground = np.zeros((2, 32, 32), np.int64)
    before, after = ground.copy(), ground.copy()
    before[:, 2:10, 2:10], after[:, 20:28, 20:28] = 1, 1
    assert np.linalg.norm(displacements(before, after, 3)[0, 0]) > 1  # the ground's centroid shifts, too
    assert moving_slots(before, after, 3).tolist() == [1]
    assert moving_slots(before, before, 3).tolist() == []


def test_agreement_is_one_of_equal_minus_one_of_opposite_and_none_of_still_motion() -> None:
    one = np.random.default_rng(0).normal(size=(500, 3, 2))
    other = np.random.default_rng(1).normal(size=(500, 3, 2))
    assert agreement(one, 2 * one + 5) == pytest.approx(1.0)
    assert agreement(one, -one) == pytest.approx(-1.0)
    assert abs(agreement(one, other) or 9) < 0.1
    assert agreement(one, np.ones_like(one)) is None


def test_the_same_mover_is_counted_where_something_moves() -> None:
    one, other = np.zeros((4, 2, 2)), np.zeros((4, 2, 2))
    one[:3, 0, 0], other[:2, 0, 1], other[2, 1, 0] = 5.0, 3.0, 3.0
    assert same_mover(one, other) == pytest.approx(2 / 3)
    assert same_mover(np.zeros((4, 2, 2)), other) is None


def test_constancy_is_one_of_constant_effects_and_about_zero_of_random_ones() -> None:
    means = np.arange(6.0)[:, None, None] * np.ones((6, 40, 4))
    noise = np.random.default_rng(0).normal(size=(6, 40, 4))
    assert explained_by_group(means) == pytest.approx(1.0)
    assert explained_by_group(noise) == pytest.approx(0.0, abs=0.05)
    assert explained_by_group(noise[:1]) is None
    assert explained_by_group(np.ones((3, 4, 2))) is None
    # Between-group variance as large as within: half, whatever the numbers.
    groups = np.random.default_rng(1).normal(size=(400, 1, 1))
    assert explained_by_group(groups + np.random.default_rng(2).normal(size=(400, 20, 1))) == pytest.approx(
        0.5, abs=0.05
    )


def test_change_inside_a_region_is_one_spread_evenly_zero() -> None:
    inside = np.zeros((1, 4, 4), bool)
    inside[:, :2] = True
    found = change_in(inside.astype(float), inside)
    assert found is not None
    assert (found.share, found.area, found.excess) == (1.0, 0.5, 1.0)
    even = change_in(np.ones((1, 4, 4)), inside)
    assert even is not None
    assert even.excess == 0.0
    assert change_in(np.zeros((1, 4, 4)), inside) is None


def test_squared_change_is_in_units_of_the_range() -> None:
    black, white = np.zeros((1, 2, 2, 3), np.uint8), np.full((1, 2, 2, 3), 255, np.uint8)
    assert squared_change(black, white).tolist() == [[[1.0, 1.0], [1.0, 1.0]]]


def test_a_window_that_moves_alone_has_no_other_to_compare_with() -> None:
    start = np.stack([square(2, 2)] * 3)
    true = np.stack([square(20, 2), *start[1:]])
    elsewhere = np.array([1, 0, 0])
    windows = Windows(
        torch.zeros(3, 6, 2, 4), torch.zeros(3, 5, 4), np.zeros((3, 6, 32, 32, 3), np.uint8), elsewhere, elsewhere + 1
    )
    drawn = [Drawn(np.zeros((3, 32, 32, 3), np.uint8), labels) for labels in (start, true, true, true)]
    lines, _ = transfer_lines(Replayed(windows, *drawn, None), 2, [0, 1])
    assert lines[-1].note == "no other window to compare with moves"


def test_slots_that_latents_do_not_see_may_move_by_themselves() -> None:
    """Slot 1 is replayed as it moved, slot 2 goes its own way."""

    def frames(*places: tuple[int, int]) -> np.ndarray:
        return np.stack([np.maximum(square(x, 4), 2 * square(other, 20)) for x, other in places])

    start, true, own = frames((2, 10), (2, 10)), frames((6, 2), (18, 20)), frames((6, 20), (18, 2))
    windows = Windows(
        torch.zeros(2, 6, 3, 4), torch.zeros(2, 5, 4), np.zeros((2, 6, 32, 32, 3), np.uint8), *[np.array([1, 0])] * 2
    )
    drawn = [Drawn(np.zeros((2, 32, 32, 3), np.uint8), labels) for labels in (start, true, own)]
    found = [transfer_lines(Replayed(windows, *drawn, None, None), 3, told)[0][0] for told in ([0, 1, 2], [0, 1])]
    assert found[0].verdict == "bad"
    assert found[1].value == pytest.approx(1.0, abs=0.01)
    assert [one.note for one in found] == ["2 windows of 5 steps", "2 windows of 5 steps, slots 1, 2"]
