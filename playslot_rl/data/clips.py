"""What a training is shown of unlabelled videos: clips, drawn for each step, on the device that computes.

Shapes: B batch, b own share of it, T frames, H W image height and width.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.agreement import say_once
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.stream import ShuffleBuffer, streams_of
from playslot_rl.data.views import IntArray
from playslot_rl.data.weighted import draw_episodes
from playslot_rl.data.windows import sample_windows, split_episodes, spread_windows, valid_starts
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators


class Clips:
    """Clips of unlabelled videos: windows of the training episodes, and spread ones of the episodes held out, or of the
    training ones where none are.

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
        fits = source.lengths >= frames
        self.train_episodes, held_out = split_episodes(source.episodes, validation, seed, fits, source.recorded)
        self.validated = "training" if np.isin(held_out, self.train_episodes).any() else "held-out"
        self.held_out = self.spread(held_out)

    def say_short(self) -> None:
        """Say how many episodes have no window, and are left out."""
        source, short = self.source, int((self.source.lengths < self.frames).sum())
        if short:
            left = f"{short} of {source.episodes} episodes have fewer frames than the window of {self.frames}"
            say_once(f"note: {source.name}: {left}: they are left out")

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

    def spread(self, episodes: IntArray, count: int | None = None) -> IntArray:
        """At most `count` (None: `shown`) disjoint windows of episodes: row indices (at most that, T)."""
        most = self.shown if count is None else count
        return spread_windows(self.source.starts, self.source.lengths, self.frames, most, episodes)

    def scenes(self, least: int = 8, most: int = 16) -> list[IntArray]:
        """Spread windows of the training episodes of each scene, a task before a camera. Scenes of fewer episodes than
        `least` are one, with those beyond the `most` that have the most: a median of few shows what lies in them. Of
        streams fewer windows are read.
        """
        there = self.train_episodes[self.source.lengths[self.train_episodes] >= self.frames]
        of, episodes = np.unique(self.source.scenes[there], return_inverse=True, return_counts=True)[1:]
        large = np.argsort(-episodes, kind="stable")[: min(most, int((episodes >= least).sum()))]
        parts = [there[of == scene] for scene in np.sort(large)] + [there[~np.isin(of, large)]]
        parts = [part for part in parts if len(part)]
        count = max(8, self.shown // len(parts)) if streams_of(self.source.frames) else self.shown
        return [self.spread(part, count) for part in parts]

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
        first, valid = valid_starts(source.starts, source.lengths, self.frames, self.train_episodes)
        groups = np.zeros_like(first)
        weights: npt.NDArray[np.float64] = np.ones(1)
        if source.shares is not None:
            groups, weights = source.shares.of(first), source.shares.weights
        return ShuffleBuffer(source.frames, first, valid, groups, weights / weights.sum(), self.seed)

    def validation_batches(self) -> list[IntArray]:
        """The held-out windows, about eight at a time."""
        return np.array_split(self.held_out, max(1, len(self.held_out) // 8))
