"""Demonstrations of several tasks take turns, so that the first ones, whose actions are shown, and the last ones, which
are held out, are of all tasks in proportion. Sets named one after the other would give those of the first set and of
the last.

    place of the k-th of the n_i episodes of task i = (k + 1/2) / n_i,   k = 0 .. n_i - 1

Shapes: R episodes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def turns(tasks: Sequence[str]) -> npt.NDArray[np.int64]:
    """The order of episodes of these tasks, int64 (R,); those of one place as their tasks first come up.

    >>> turns(["reach", "reach", "reach", "reach", "push", "push"]).tolist()
    [0, 4, 1, 2, 5, 3]
    """
    number = {task: i for i, task in enumerate(dict.fromkeys(tasks))}
    of = np.array([number[task] for task in tasks], np.int64)
    place = np.zeros(len(of))
    for i in range(len(number)):
        there = np.flatnonzero(of == i)
        place[there] = (np.arange(len(there)) + 0.5) / len(there)
    order: npt.NDArray[np.int64] = np.lexsort((of, place))
    return order
