"""Windows of consecutive frames, drawn uniformly over all places where one fits.

Shapes: F frames of a data set, E episodes, B batch, T window.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from playslot_rl.data.views import IntArray
from playslot_rl.data.weighted import Shares, draw_episodes
from playslot_rl.errors import DataError


def sample_windows(
    starts: npt.ArrayLike,
    lengths: npt.ArrayLike,
    window: int,
    batch: int,
    generator: np.random.Generator,
    episodes: Sequence[int] | IntArray | None = None,
    shares: Shares | None = None,
) -> IntArray:
    """Draw windows (B, T) of rows: every valid first frame is equally likely, so long episodes count for more; with
    `shares`, in a set that was drawn by its weight. A DataError where no episode has `window` frames.

    Example:
        >>> sample_windows([0, 3], [3, 2], 3, 2, np.random.default_rng(0))
        array([[0, 1, 2],
               [0, 1, 2]])
    """
    first, valid = valid_starts(starts, lengths, window, episodes)
    if shares is not None:
        episode, offset = draw_episodes(shares, first, valid, batch, generator)
    else:
        cumulative = np.cumsum(valid)
        drawn = generator.integers(0, cumulative[-1], size=batch)
        episode = np.searchsorted(cumulative, drawn, side="right")
        offset = drawn - (cumulative[episode] - valid[episode])
    rows: IntArray = (first[episode] + offset)[:, None] + np.arange(window)
    return rows


def spread_windows(
    starts: npt.ArrayLike, lengths: npt.ArrayLike, window: int, count: int, episodes: Sequence[int] | IntArray
) -> IntArray:
    """At most `count` disjoint windows (., T) of rows, spread evenly over the episodes; a stage's validation set. A
    DataError where no episode has `window` frames."""
    first, valid = valid_starts(starts, lengths, window, episodes)
    begins = np.concatenate([s + np.arange(0, n, window) for s, n in zip(first, valid, strict=True)])
    windows: IntArray = begins[:, None].astype(np.int64) + np.arange(window)
    return spread_evenly(windows, count)


def spread_evenly(items: IntArray, count: int) -> IntArray:
    """At most `count` of some items, spread evenly over them."""
    if len(items) <= count:
        return items
    return items[np.linspace(0, len(items) - 1, count).round().astype(np.int64)] if count else items[:0]


def valid_starts(
    starts: npt.ArrayLike, lengths: npt.ArrayLike, window: int, episodes: Sequence[int] | IntArray | None
) -> tuple[IntArray, IntArray]:
    first, length = np.asarray(starts, np.int64), np.asarray(lengths, np.int64)
    if episodes is not None:
        chosen = np.asarray(episodes, np.int64)
        first, length = first[chosen], length[chosen]
    valid = np.maximum(length - window + 1, 0)
    if valid.sum() == 0:
        longest = int(length.max()) if len(length) else 0
        raise DataError(
            f"got episodes of at most {longest} frames ({len(length)} of them), expected at least one of {window}: "
            "shorten the window of its stage (such as slots.clip_frames, dynamics.predicted_frames), lower data.stride "
            "where it is above 1, or collect longer episodes"
        )
    return first, valid


def split_episodes(
    episodes: int, validation: float, seed: int, usable: npt.ArrayLike = True, recorded: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Split episode indices into training and validation, sorted, at random but always the same for a seed; all views
    of a `recorded` episode (its number, (E,)) lie in one of them.

    At least one of the `usable` (bool (E,): long enough) is held out and one is not, if the fraction is not 0 and there
    are two: then as many of the drawn order as that takes. With none, validation is the training set.
    """
    if recorded is not None:
        numbers, first = np.unique(recorded, return_index=True)
        parts = split_episodes(len(numbers), validation, seed, np.broadcast_to(usable, episodes)[first])
        training, validated = (np.flatnonzero(np.isin(recorded, numbers[part])).astype(np.int64) for part in parts)
        return training, validated
    order = np.random.default_rng(seed).permutation(episodes).astype(np.int64)
    fits = np.flatnonzero(np.broadcast_to(usable, episodes)[order])
    held_out = int(np.clip(round(episodes * validation), fits[0] + 1, fits[-1])) if validation and len(fits) > 1 else 0
    training = np.sort(order[held_out:])
    return training, np.sort(order[:held_out]) if held_out else training
