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

from playslot_rl.data.cache import ENTRY_NAME, ArrayWriter, CachePlace, build_once, cache_folder, load_cached, room
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.stream import streams_of
from playslot_rl.data.views import RowView
from playslot_rl.frames import normalise
from playslot_rl.seeds.draws import step_generator
from playslot_rl.storage.atomic import write_json

if TYPE_CHECKING:
    from playslot_rl.modules.savi import SAVi

SlotRows = npt.NDArray[np.float32]
"""Slots (F, N, D) by row: an array, or (`RowView`) several that are indexed by rows as one."""

_FORMAT = "1"
_BY_ROW = "2"  # where episodes are left out between others: slots stand at their frames' rows, too
_DRAWN = "by 32"  # initial slots that are drawn: once a stream's were drawn for as many episodes as its buffer held
EPISODES_A_BATCH = 32  # at most; initial slots are drawn for so many, however many are parsed together
MARK_EVERY = 16  # batches after which a build says how far it is
BEGUN = "begun.json"  # how many episodes are parsed, in an entry that is being made
FRAMES_A_PASS = 4  # frames of each episode parsed at a time: bounds the memory of the encoder's activations


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
        return cast("SlotRows", RowView(parts))
    # Of some chosen episodes those between are left out.
    whole = np.array_equal(source.starts, np.cumsum(source.lengths) - source.lengths)
    identity = [_FORMAT if whole else _BY_ROW, source.fingerprint, source.camera, source.image_size, savi_fingerprint]
    identity += [_DRAWN] if savi.config.initial == "gaussian" else []
    key = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
    folder = cache_folder(cache) / "slots" / key
    count = int((source.starts + source.lengths).max())

    def build(part: Path) -> None:
        shape = (count, savi.config.n_slots, savi.config.slot_dim)
        mark = part / BEGUN
        begun = int(json.loads(mark.read_text())) if mark.is_file() else 0  # episodes that a killed build has parsed
        left = int(source.lengths[begun:].sum())
        if progress:
            print(f"slots: parsing {left} frames once", file=sys.stderr, flush=True)
        with room(cache, int(np.prod(shape)) * 4, key):
            writer = ArrayWriter(part / "slots.npy", shape, np.float32, begun > 0)
        for number, episodes in enumerate(_batches(source, begun), 1):
            for episode, slots in zip(episodes, _parse(source, savi, device, episodes), strict=True):
                writer.write(slots, int(source.starts[episode]))
            if number % MARK_EVERY == 0:
                writer.sync()
                write_json(mark, int(episodes[-1]) + 1)
        writer.close()
        facts = {"name": source.name, "camera": source.camera, "fingerprint": source.fingerprint}
        write_json(part / ENTRY_NAME, {**facts, "savi": savi_fingerprint})
        mark.unlink(missing_ok=True)

    build_once(folder, build)
    slots: npt.NDArray[np.float32] = load_cached(folder, "slots.npy", lambda: build_once(folder, build))
    return slots


def _batches(source: EpisodeFrames, first: int = 0) -> Iterator[npt.NDArray[np.int64]]:
    """Numbers of the episodes that are parsed together, from one on that begins a batch: 32 from a multiple of 32 on;
    of frames that are streamed as many of them as a quarter of the buffer holds, which may be fewer."""
    lengths, streams = source.lengths, streams_of(source.frames)
    most = streams[0].buffer // 4 if streams else None
    while first < len(lengths):
        last = min(first - first % EPISODES_A_BATCH + EPISODES_A_BATCH, len(lengths))
        if most is not None:
            last = max(first + 1, first + int(np.searchsorted(np.cumsum(lengths[first:last]), most, side="right")))
        yield np.arange(first, last)
        first = last


def parse_episodes(
    source: EpisodeFrames, savi: SAVi, device: torch.device | str = "cpu"
) -> Iterator[npt.NDArray[np.float32]]:
    """Parse all episodes in order: yields float32 (frames of the episode, N, D)."""
    for episodes in _batches(source):
        yield from _parse(source, savi, device, episodes)


@torch.no_grad()
def _parse(
    source: EpisodeFrames, savi: SAVi, device: torch.device | str, episodes: npt.NDArray[np.int64]
) -> list[npt.NDArray[np.float32]]:
    """Parse some episodes together: each float32 (its frames, N, D)."""
    savi = savi.to(device).eval()
    lengths = source.lengths[episodes]
    # Shorter episodes repeat their last frame; SAVi is causal, so what is kept does not see it.
    steps = np.minimum(np.arange(int(lengths.max())), lengths[:, None] - 1)
    rows = source.starts[episodes][:, None] + steps
    group = int(episodes[0]) // EPISODES_A_BATCH * EPISODES_A_BATCH
    drawn = min(EPISODES_A_BATCH, source.episodes - group)
    initial = savi.initializer(drawn, step_generator(0, group, "slot_cache", device))[episodes - group]
    pieces, state = [], None
    for begin in range(0, rows.shape[1], FRAMES_A_PASS):
        frames = normalise(source.pixels(rows[:, begin : begin + FRAMES_A_PASS]).to(device))
        slots, state = savi(frames, state, initial=initial)
        pieces.append(slots.float().cpu().numpy())
    parsed = np.concatenate(pieces, axis=1)
    return [parsed[i, :length] for i, length in enumerate(lengths)]
