"""Holding out whole groups (episodes, clips): transitions of one group are too alike to stand on both sides."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def hold_out(groups: npt.NDArray[np.int64], fraction: float, seed: int, what: str) -> tuple[npt.NDArray[np.bool_], int]:
    """Choose groups at random.

    Args:
        groups: (M,) group of each row.
        fraction: of the groups, to hold out; at least one is held out and at least one kept.
        seed: of the choice.
        what: who asks and what a group is, for the error: `probe_moves: clip`.

    Returns:
        (M,) mask of the rows held out, and how many groups they are.

    Raises:
        ValueError: there are fewer than two groups.
    """
    names = np.unique(groups)
    if len(names) < 2:
        who, _, group = what.partition(": ")
        raise ValueError(f"{who}: got {len(names)} {group}, expected at least 2 to hold some out")
    shuffled = np.random.default_rng(seed).permutation(names)
    held = shuffled[: min(len(names) - 1, max(1, round(fraction * len(names))))]
    return np.isin(groups, held), len(held)
