"""Windows of consecutive frames, drawn uniformly over all places where one fits.

Shapes: F frames of a data set, E episodes, B batch, T window.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.stream import ShuffleBuffer, streams_of
from playslot_rl.data.views import IntArray as IntArray
from playslot_rl.data.weighted import Shares, draw_episodes
from playslot_rl.errors import DataError
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators


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
    first, valid = _valid_starts(starts, lengths, window, episodes)
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
    first, valid = _valid_starts(starts, lengths, window, episodes)
    begins = np.concatenate([s + np.arange(0, n, window) for s, n in zip(first, valid, strict=True)])
    windows: IntArray = begins[:, None].astype(np.int64) + np.arange(window)
    return spread_evenly(windows, count)


def spread_evenly(items: IntArray, count: int) -> IntArray:
    """At most `count` of some items, spread evenly over them."""
    if len(items) <= count:
        return items
    return items[np.linspace(0, len(items) - 1, count).round().astype(np.int64)] if count else items[:0]


def _valid_starts(
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
            "shorten the training window or collect longer episodes"
        )
    return first, valid


def split_episodes(episodes: int, validation: float, seed: int) -> tuple[IntArray, IntArray]:
    """Split episode indices into training and validation, sorted, at random but always the same for a seed.

    At least one is held out, if the fraction is not 0 and there are two; with none, validation is the training set.
    """
    held_out = round(episodes * validation)
    if validation > 0 and episodes >= 2:
        held_out = min(max(1, held_out), episodes - 1)
    order = np.random.default_rng(seed).permutation(episodes).astype(np.int64)
    training = np.sort(order[held_out:])
    return training, np.sort(order[:held_out]) if held_out else training


class Clips:
    """Clips of unlabelled videos: windows of the training episodes, and spread ones of the episodes held out.

    Args:
        shown: at most so many windows validate.
        resident: whether a GPU may keep all frames (`playslot_rl.data.device_rows`).

    Raises:
        DataError: no episode has `frames` frames.
    """

    def __init__(
        self,
        source: EpisodeFrames,
        frames: int,
        validation: float,
        seed: int,
        shown: int = 32,
        resident: bool = True,
    ) -> None:
        self.source, self.frames, self.shown, self.seed = source, frames, shown, seed
        self.resident = resident and not streams_of(source.frames)
        self._pixels: DeviceRows | None = None
        self.train_episodes, held_out = split_episodes(source.episodes, validation, seed)
        self.held_out = self.spread(held_out)

    def pixels(self, rows: IntArray, device: torch.device) -> Tensor:
        """Frames of rows (...), uint8 (..., 3, H, W), on a device."""
        if self._pixels is None or self._pixels.device != device:
            self._pixels = DeviceRows(self.source.pixels, len(self.source.frames), device, self.resident)
        return self._pixels(rows)

    def batch(
        self, stream: str, count: int, generators: StepGenerators, device: torch.device, frames: int | None = None
    ) -> Tensor:
        """The own clips of a step's `count`, or their first `frames` frames: uint8 (b, T, 3, H, W); `stream` names the
        generator that draws them.
        """
        return self.pixels(own_rows(self.sample(count, generators.numpy(stream)))[:, :frames], device)

    def spread(self, episodes: IntArray) -> IntArray:
        """At most `shown` disjoint windows of episodes: row indices (at most `shown`, T)."""
        return spread_windows(self.source.starts, self.source.lengths, self.frames, self.shown, episodes)

    def sample(self, batch: int, generator: np.random.Generator) -> IntArray:
        """Row indices (batch, T) of windows of the training episodes, drawn uniformly; of sets with weights
        (`playslot_rl.data.weighted`), uniformly in a set that was drawn by its weight; of streams
        (`playslot_rl.data.stream`), from the shuffle buffer of the step that the generator belongs to.
        """
        source, chosen = self.source, self._near(batch, generator)
        return sample_windows(source.starts, source.lengths, self.frames, batch, generator, chosen, source.shares)

    def sample_first(self, batch: int, generator: np.random.Generator) -> IntArray:
        """First rows (batch,) of training episodes in which a clip fits, drawn as `sample` draws windows."""
        source, chosen = self.source, self._near(batch, generator)
        fits = chosen[source.lengths[chosen] >= self.frames]
        if source.shares is None:
            first: IntArray = source.starts[generator.choice(fits, batch)]
            return first
        episode, _ = draw_episodes(source.shares, source.starts[fits], np.ones_like(fits), batch, generator)
        first = source.starts[fits[episode]]
        return first

    def _near(self, batch: int, generator: np.random.Generator) -> IntArray:
        """Training episodes that can be drawn from: all, or those in the shuffle buffer."""
        if self._buffer is None:
            return self.train_episodes
        near: IntArray = self.train_episodes[self._buffer.episodes(getattr(generator, "step", 0), batch)]
        return near

    @cached_property
    def _buffer(self) -> ShuffleBuffer | None:
        source = self.source
        if not streams_of(source.frames):
            return None
        first, valid = _valid_starts(source.starts, source.lengths, self.frames, self.train_episodes)
        groups = np.zeros_like(first)
        weights: npt.NDArray[np.float64] = np.ones(1)
        if source.shares is not None:
            groups, weights = source.shares.of(first), source.shares.weights
        return ShuffleBuffer(source.frames, first, valid, groups, weights / weights.sum(), self.seed)

    def validation_batches(self) -> list[IntArray]:
        """The held-out windows, about eight at a time."""
        return np.array_split(self.held_out, max(1, len(self.held_out) // 8))
