"""Statistics as LeRobot keeps them: of each episode in `meta/episodes`, of all in `meta/stats.json`.

Numbers: per component of the last axis; a frame's further axes count as rows. Cameras: per channel, scaled to [0, 1],
from some evenly spread frames of each episode.
Quantiles of the whole are the weighted means of those of the episodes, as LeRobot makes them.

Note: exact quantiles; LeRobot reads them off a histogram of 5000 bins. Exact means and deviations, too: LeRobot's
running float32 sums (`rounded`) are off by a part that grows with the number of pixels: of 100 bright frames of 64x64
the deviation by a quarter. A data set may have either; `tests/datasets` compares them with LeRobot's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.tables import Array, Stats

QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
BASIC: Final = ("min", "max", "mean", "std", "count")
LARGE_IMAGE: Final = 300  # from this side on LeRobot thins out the pixels
THINNED_SIDE: Final = 150


def sampled(length: int) -> list[int]:
    """Frames of an episode that LeRobot takes for a camera's statistics."""
    count = max(min(100, length), min(int(length**0.75), 10_000))
    return [int(i) for i in np.round(np.linspace(0, length - 1, count))]


def thinned(frame: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(H, W, C) -> fewer rows and columns where the frame is large."""
    height, width = frame.shape[:2]
    if max(height, width) < LARGE_IMAGE:
        return frame
    factor = max(height, width) // THINNED_SIDE
    return frame[::factor, ::factor]


def rounded(pieces: Iterable[Array]) -> dict[str, Array]:
    """Mean and standard deviation (K,) of rows (n, K), one piece after the other, as LeRobot's `RunningQuantileStats`
    comes by them, to the last bit: it adds up all values and their squares one row after the other, integers as
    float32, and takes the variance as the difference of two means.
    """
    count = 0
    total: Any = None
    squares: Any = None
    for piece in pieces:
        rows = piece.astype(np.result_type(piece.dtype, np.float32), copy=False)
        count += len(rows)
        total, squares = _added(total, rows), _added(squares, rows**2)
    mean = total / count
    return {"mean": mean, "std": np.sqrt(np.maximum(0, squares / count - mean**2))}


def _added(total: Any, rows: Array) -> Any:
    return np.add.reduce(rows if total is None else np.concatenate([total[None], rows]))


def rows_of(values: Array) -> Array:
    """One episode's values, (n,) or (n, ..., K), as the rows that statistics are taken over, (n ..., K); K may be 1."""
    return values.reshape(-1, 1 if values.ndim == 1 else values.shape[-1])


def of_numbers(values: Array) -> dict[str, Array]:
    """Statistics of one episode's values, (n,) or (n, ..., K): float64 (K,), or (1,); `count` is n."""
    rows = rows_of(np.asarray(values, np.float64))
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    # No interpolation, as theirs: numpy's `inverted_cdf`, which sorts anew for each of them.
    places = np.ceil(len(rows) * np.array(list(QUANTILES.values())) - 1).clip(0).astype(np.int64)
    quantiles = np.sort(rows, axis=0)[places]
    return {**stats, "count": np.array([len(values)]), **dict(zip(QUANTILES, quantiles, strict=True))}


def of_frames(frames: Sequence[npt.NDArray[np.uint8]]) -> dict[str, Array]:
    """Statistics of one episode's sampled frames (H, W, C): float64 (C, 1, 1), in [0, 1]."""
    channels = np.stack(frames).reshape(-1, frames[0].shape[-1]).T
    # From the counts of the 256 levels: exact, and many times faster than sorting pixels for the quantiles.
    levels = [_of_levels(np.bincount(channel, minlength=256)) for channel in channels]
    stats = {name: np.array([level[name] for level in levels]).reshape(-1, 1, 1) for name in levels[0]}
    return {**stats, "count": np.array([len(frames)])}


def _of_levels(counts: Array) -> dict[str, float]:
    values, total, below = np.arange(256) / 255.0, int(counts.sum()), np.cumsum(counts)
    mean = float(counts @ values) / total
    present = np.flatnonzero(counts)
    stats = {"min": values[present[0]], "max": values[present[-1]], "mean": mean}
    stats["std"] = float(np.sqrt(counts @ (values - mean) ** 2 / total))
    return {**stats, **{name: values[np.searchsorted(below, share * total)] for name, share in QUANTILES.items()}}


class Aggregate:
    """Statistics of all from those of the episodes, one after the other, weighted by their counts.

    Deviations are combined as by Chan, Golub and LeVeque: no difference of large numbers.
    """

    def __init__(self) -> None:
        self._features: dict[str, dict[str, Array]] = {}

    def add(self, episode: Stats) -> None:
        for name, given in episode.items():
            values = {key: np.asarray(value, np.float64) for key, value in given.items()}
            if not {*BASIC} <= values.keys() or not values["count"].reshape(-1)[:1] > 0:
                raise ValueError(f"statistics of {name}: {', '.join(sorted(values))} of {given.get('count')} values")
            values["count"] = values["count"].reshape(-1)[:1]
            there = self._features.get(name)
            self._features[name] = values if there is None else _joined(there, values)

    def result(self) -> Stats:
        return {name: {**v, "count": v["count"].astype(np.int64)} for name, v in self._features.items()}


def _joined(one: dict[str, Array], other: dict[str, Array]) -> dict[str, Array]:
    for key in one.keys() & other.keys():
        if one[key].shape != other[key].shape:
            raise ValueError(f"{key} of {other[key].shape} beside {one[key].shape}")
    n, m = float(one["count"][0]), float(other["count"][0])
    share = m / (n + m)
    total = {key: one[key] + share * (other[key] - one[key]) for key in one if key in other}
    between = n * m / (n + m) * (other["mean"] - one["mean"]) ** 2
    total["std"] = np.sqrt((n * one["std"] ** 2 + m * other["std"] ** 2 + between) / (n + m))
    total["min"], total["max"] = np.minimum(one["min"], other["min"]), np.maximum(one["max"], other["max"])
    return total | {"count": one["count"] + other["count"]}


def reduced(stats: dict[str, Array], width: int) -> dict[str, Array]:
    """Statistics of numbers as (K,) where they are those of every component of a frame, (..., K), all else as it is.

    LeRobot keeps them so of an episode of one frame, and what this package once wrote has them of every episode.
    """
    finer = {k: v.reshape(-1, width) for k, v in stats.items() if k != "count" and v.ndim > 1 and v.shape[-1] == width}
    total = {name: values.mean(0) for name, values in finer.items()}
    if {"min", "max", "mean", "std"} <= finer.keys():
        total["min"], total["max"] = finer["min"].min(0), finer["max"].max(0)
        total["std"] = np.sqrt((finer["std"] ** 2 + (finer["mean"] - total["mean"]) ** 2).mean(0))
    return {**stats, **total}


def differing(
    stored: dict[str, Array], actual: dict[str, Array], theirs: dict[str, Array] | None = None, loose: float = 0.0
) -> list[str]:
    """Names of the basic statistics that are missing, not finite, or differ.

    A value no further from `actual` than `theirs`, with LeRobot's rounding, is not wrong. `loose` is a tolerance of
    mean and standard deviation; with one, count, min and max are not compared.
    """
    found = []
    scale = float(max(np.abs(actual["min"]).max(), np.abs(actual["max"]).max(), 1e-6))
    # Sums in another order, as by another numpy: float32 variances as differences lose about 3.5e-4 of the mean.
    tolerance = {"std": 2e-3 * scale} if not loose else {"std": loose, "mean": loose}
    for name in BASIC:
        got = stored.get(name)
        if got is None or not np.isfinite(got).all() or got.size != actual[name].size:
            found.append(name)
            continue
        if loose and name not in tolerance:
            continue
        want = actual[name].reshape(-1)
        rounding = np.abs(theirs[name].reshape(-1) - want) if theirs is not None else 0.0
        if (np.abs(got.reshape(-1) - want) > tolerance.get(name, 1e-4 * scale) + rounding).any():
            found.append(name)
    return found
