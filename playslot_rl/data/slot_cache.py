"""The slot cache: frozen SAVi's slots of a whole data set, computed once, keyed by weights and data.

Shapes: F frames, E episodes, N slots, D slot width.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
import torch

from playslot_rl.data.cache import ArrayWriter, CachePlace, build_once, cache_folder, load_cached
from playslot_rl.data.cache_entries import ENTRY_NAME, room
from playslot_rl.data.source import ConcatFrames, EpisodeFrames
from playslot_rl.data.stream import streams_of
from playslot_rl.frames import normalise
from playslot_rl.seeding import step_generator
from playslot_rl.storage.atomic import write_json

if TYPE_CHECKING:
    from playslot_rl.modules.savi import SAVi

SlotRows = npt.NDArray[np.float32]
"""Slots (F, N, D) by row: an array, or (`ConcatFrames`) several that are indexed by rows as one."""

_FORMAT = "1"
_BY_ROW = "2"
"""Where episodes are left out between others: slots stand at their frames' rows, too."""
EPISODES_A_BATCH = 32
FRAMES_A_PASS = 4
"""Frames of each episode parsed at a time: bounds the memory of the encoder's activations."""


def slot_cache(
    source: EpisodeFrames,
    savi: SAVi,
    savi_fingerprint: str,
    cache: CachePlace = "",
    device: torch.device | str = "cpu",
    progress: bool = False,
) -> SlotRows:
    """Slots of every frame of a data set, each episode parsed from its first frame on.

    Args:
        source: the frames; the first episodes of a data set will do.
        savi: SAVi with frozen weights; moved to `device` and put in eval mode.
        savi_fingerprint: of its weights (`StageCheckpoint.fingerprint`).
        cache: the cache; empty means the default one.
        device: where to compute.
        progress: print a line to standard error before a long computation.

    Returns:
        float32 (F, N, D), memory-mapped, by the row of the frame; of sets with weights, the sets' caches in a row.

    Raises:
        OutputError: full disk.

    Note: sampled initial slots (`gaussian`) are drawn by generators with fixed seeds, so the slots repeat.
    """
    shares = source.shares
    if shares is not None and shares.sources and source.fingerprint == shares.fingerprint:
        # Each set's own, whatever the weights.
        parts = [slot_cache(s, savi, savi_fingerprint, cache, device, progress) for s in shares.sources]
        return cast("SlotRows", ConcatFrames(parts))
    whole = _in_order(source)
    identity = [_FORMAT if whole else _BY_ROW, source.fingerprint, source.camera, source.image_size, savi_fingerprint]
    key = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
    folder = cache_folder(cache) / "slots" / key
    count = int((source.starts + source.lengths).max())

    def build(temporary: Path) -> None:
        if progress:
            print(f"slots: parsing {int(source.lengths.sum())} frames once", file=sys.stderr, flush=True)
        shape = (count, savi.config.n_slots, savi.config.slot_dim)
        with room(cache, int(np.prod(shape)) * 4, key):
            writer = ArrayWriter(temporary / "slots.npy", shape, np.float32)
        for start, slots in zip(source.starts, parse_episodes(source, savi, device), strict=True):
            writer.write(slots, int(start))
        writer.close(whole=whole)
        facts = {"name": source.name, "camera": source.camera, "fingerprint": source.fingerprint}
        write_json(temporary / ENTRY_NAME, {**facts, "savi": savi_fingerprint})

    build_once(folder, build)
    slots: npt.NDArray[np.float32] = load_cached(folder, "slots.npy", lambda: build_once(folder, build))
    return slots


def _batches(lengths: npt.NDArray[np.int64], most: int | None) -> Iterator[npt.NDArray[np.int64]]:
    """Numbers of the episodes that are parsed together, at most so many frames of them, but one."""
    first = 0
    while first < len(lengths):
        last = min(first + EPISODES_A_BATCH, len(lengths))
        if most is not None:
            last = max(first + 1, first + int(np.searchsorted(np.cumsum(lengths[first:last]), most, side="right")))
        yield np.arange(first, last)
        first = last


def _in_order(source: EpisodeFrames) -> bool:
    """Whether the episodes fill all rows up to the last one of theirs; of some chosen ones, those between are left."""
    return bool(np.array_equal(source.starts, np.cumsum(source.lengths) - source.lengths))


@torch.no_grad()
def parse_episodes(
    source: EpisodeFrames, savi: SAVi, device: torch.device | str = "cpu"
) -> Iterator[npt.NDArray[np.float32]]:
    """Parse all episodes in order: yields float32 (frames of the episode, N, D).

    Several at a time; of frames that are streamed as many as a quarter of the buffer holds, which may be fewer.
    """
    savi = savi.to(device).eval()
    streams = streams_of(source.frames)
    most = streams[0].buffer // 4 if streams else None
    for episodes in _batches(source.lengths, most):
        first = int(episodes[0])
        lengths = source.lengths[episodes]
        # Shorter episodes repeat their last frame; SAVi is causal, so what is kept does not see it.
        steps = np.minimum(np.arange(int(lengths.max())), lengths[:, None] - 1)
        rows = source.starts[episodes][:, None] + steps
        generator = step_generator(0, first, "slot_cache", device)
        pieces, state = [], None
        for begin in range(0, rows.shape[1], FRAMES_A_PASS):
            frames = normalise(source.pixels(rows[:, begin : begin + FRAMES_A_PASS]).to(device))
            slots, state = savi(frames, state, generator)
            pieces.append(slots.float().cpu().numpy())
        parsed = np.concatenate(pieces, axis=1)
        for i, length in enumerate(lengths):
            yield parsed[i, :length]
