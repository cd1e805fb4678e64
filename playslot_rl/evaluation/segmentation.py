"""How well slots segment known objects: adjusted Rand index, and which slot holds which object.

Shapes: T frames, O objects, N slots, H W image height and width. Label images count from 0, the ground.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Labels = npt.NDArray[Any]


def adjusted_rand_index(truth: Labels, predicted: Labels, foreground: bool = False) -> float:
    """Agreement of two labellings of the same pixels: 1 if equal up to names, about 0 for a random one.

    A clip is scored as a whole, as in SAVi's paper: a slot that changes its object in mid-clip loses.

    Args:
        truth: integers of any shape, 0 the ground.
        predicted: integers of the same shape; the names of the labels do not matter.
        foreground: leave out the pixels of the ground (FG-ARI).

    Raises:
        ValueError: the shapes differ, or no pixel is left.
    """
    from sklearn.metrics import adjusted_rand_score

    if truth.shape != predicted.shape:
        raise ValueError(f"adjusted_rand_index: got {truth.shape} and {predicted.shape}, expected one shape")
    chosen = truth > 0 if foreground else np.ones_like(truth, bool)
    if not chosen.any():
        raise ValueError("adjusted_rand_index: got no pixel of an object, expected some")
    return float(adjusted_rand_score(truth[chosen], predicted[chosen]))


def overlaps(truth: Labels, predicted: Labels, objects: int, slots: int) -> npt.NDArray[np.float64]:
    """Intersection over union (O + 1, N) of ground and objects with the slots."""
    pairs = np.bincount(truth.ravel().astype(np.int64) * slots + predicted.ravel(), minlength=(objects + 1) * slots)
    both = pairs.reshape(objects + 1, slots).astype(np.float64)
    either = both.sum(1, keepdims=True) + both.sum(0, keepdims=True) - both
    found: npt.NDArray[np.float64] = both / np.maximum(either, 1.0)
    return found


def match_slots(truth: Labels, predicted: Labels, objects: int, slots: int) -> npt.NDArray[np.int64]:
    """The slot of each object in a clip: the assignment with the largest overlap in all, ground included.

    Args:
        truth: (T, H, W) integers, 0 the ground, o + 1 object o.
        predicted: (T, H, W) integers, the slot that each pixel belongs to.
        objects: O.
        slots: N.

    Returns:
        (O,), -1 for an object that gets no slot because there are too few.
    """
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(overlaps(truth, predicted, objects, slots), maximize=True)
    chosen = np.full(objects + 1, -1, np.int64)
    chosen[rows] = columns
    return chosen[1:]
