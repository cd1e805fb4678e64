"""ARI has its known values, and slots are matched to the objects they cover."""

from __future__ import annotations

import numpy as np
import pytest

from playslot_rl.config import EnvConfig
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.evaluation.objects import adjusted_rand_index, match_slots, overlaps

TRUTH = generate([1], 6, EnvConfig(name="grid_shapes")).masks[0]


@pytest.mark.parametrize("foreground", [False, True])
def test_a_perfect_segmentation_scores_one_under_any_names(foreground: bool) -> None:
    assert adjusted_rand_index(TRUTH, TRUTH, foreground) == 1.0
    assert adjusted_rand_index(TRUTH, np.array([2, 0, 1])[TRUTH], foreground) == 1.0


@pytest.mark.parametrize("foreground", [False, True])
def test_one_slot_for_everything_scores_zero(foreground: bool) -> None:
    assert adjusted_rand_index(TRUTH, np.zeros_like(TRUTH), foreground) == 0.0


def test_a_random_segmentation_scores_about_zero() -> None:
    noise = np.random.default_rng(0).integers(3, size=TRUTH.shape)
    assert abs(adjusted_rand_index(TRUTH, noise)) < 0.01


def test_foreground_does_not_look_at_the_ground() -> None:
    torn = np.where(TRUTH == 0, np.random.default_rng(0).integers(3, size=TRUTH.shape), TRUTH)
    assert adjusted_rand_index(TRUTH, torn, foreground=True) == 1.0
    assert adjusted_rand_index(TRUTH, torn) < 0.5


def test_a_slot_that_changes_its_object_in_mid_clip_loses() -> None:
    swapped = TRUTH.copy()
    swapped[3:] = np.array([0, 2, 1])[TRUTH[3:]]
    assert adjusted_rand_index(TRUTH, swapped, foreground=True) < 0.2


def test_a_known_value_of_the_index() -> None:
    # By hand: contingency [[2, 1], [0, 3]]; pairs 1 + 0 + 0 + 3 = 4, rows 3 + 3, columns 1 + 6, of 15 pairs in all.
    truth, predicted = np.array([0, 0, 0, 1, 1, 1]), np.array([0, 0, 1, 1, 1, 1])
    expected = (4 - 6 * 7 / 15) / ((6 + 7) / 2 - 6 * 7 / 15)
    assert adjusted_rand_index(truth, predicted) == pytest.approx(expected)


def test_wrong_shapes_and_empty_foregrounds_are_refused() -> None:
    with pytest.raises(ValueError, match="expected one shape"):
        adjusted_rand_index(TRUTH, TRUTH[1:])
    with pytest.raises(ValueError, match="no pixel of an object"):
        adjusted_rand_index(np.zeros((2, 2), int), np.zeros((2, 2), int), foreground=True)


def test_slots_are_matched_whatever_their_order() -> None:
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        np.testing.assert_array_equal(match_slots(TRUTH, np.array(order)[TRUTH], 2, 3), order[1:])


def test_a_slot_that_holds_ground_and_object_is_left_to_the_ground() -> None:
    merged = np.where(TRUTH == 2, 1, 0)  # object 1 and the ground share slot 0; slot 2 is empty
    chosen = match_slots(TRUTH, merged, 2, 3)
    assert chosen.tolist() == [2, 1]


def test_objects_without_a_slot_are_said_to_have_none() -> None:
    chosen = match_slots(TRUTH, np.where(TRUTH == 2, 1, 0), 2, 2)
    assert chosen.tolist() == [-1, 1]


def test_overlap_is_intersection_over_union() -> None:
    truth, predicted = np.array([[0, 1, 1, 1]]), np.array([[0, 0, 1, 1]])
    np.testing.assert_allclose(overlaps(truth, predicted, 1, 2), [[1 / 2, 0], [1 / 4, 2 / 3]])
