"""Frames of sets that fit neither memory nor the disk's cache: decoded while they are read, with a shuffle buffer.

A set is cut into blocks of whole episodes, a sixteenth of the buffer each, and the blocks are put in an order drawn
anew for every epoch. The buffer of step s is a stretch of that order,

    blocks  o(p), ..., o(p + 15),    p = floor(s b / w)

with b windows a batch and w windows a block, so that an epoch draws as many windows as there are; a batch's windows are
drawn uniformly from the buffer's blocks. A buffer that has room for all blocks holds them all. All of it is a function
of (seed, step): a resumed run reads the same frames.

Shapes: F frames, E episodes, B batch, H W image height and width.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.contents import Contents, Span, in_runs
from playslot_rl.data.frames import rgb_frames, sized
from playslot_rl.data.metadata import stated_size
from playslot_rl.data.views import FrameRows, Frames, IntArray, RowView, row_numbers
from playslot_rl.runtime import processes

BLOCKS: Final = 16  # of a full buffer
FEW: Final = 4  # with fewer blocks a buffer hardly shuffles
ORDER_STREAM: Final = 0x57EA  # keeps the order of the blocks apart from what else a seed draws


class FrameStream:
    """Frames uint8 (F, H, W, 3) that are decoded when they are read.

    Blocks that `hold` names stay in memory once they are read; of other episodes those read last, up to a quarter of
    the buffer, or a single one that is longer.
    """

    def __init__(self, contents: Contents, camera: str, size: int | None, buffer: int) -> None:
        self._spans = contents.spans  # found from the columns
        self._contents = replace(contents, columns={"episode_index": contents.columns["episode_index"]})
        self.camera, self.size, self.buffer = camera, size, buffer
        height, width = stated_size(contents.features[camera])
        self.shape = (contents.rows, size or height, size or width, 3)
        self.dtype = np.dtype(np.uint8)
        most = max(1, buffer // BLOCKS)
        # None crosses a file, so that each file is opened once.
        self.blocks = in_runs(
            self._spans, lambda run, span: run[-1].file != span.file or sum(s.length for s in run) >= most
        )
        self._first = np.array([block[0].start for block in self.blocks], np.int64)
        self._starts = np.array([span.start for span in self._spans], np.int64)
        self._held: dict[int, Frames | None] = {}
        self._coming: dict[int, Future[Frames]] = {}
        self._loose: OrderedDict[int, Frames] = OrderedDict()
        self._lock = threading.Lock()  # PyAV and Pillow release the interpreter, so two threads may ask at once
        self._ahead = ThreadPoolExecutor(1, thread_name_prefix="stream")

    def __len__(self) -> int:
        return self.shape[0]

    def block_of(self, rows: IntArray) -> IntArray:
        found: IntArray = np.searchsorted(self._first, rows, side="right").astype(np.int64) - 1
        return found

    def hold(self, blocks: Sequence[int], coming: Sequence[int] = ()) -> None:
        """Keep these blocks from now on, and no others; begin to decode those that are coming."""
        with self._lock:
            self._held = {block: self._held.get(block) for block in blocks}
            self._coming = {b: f for b, f in self._coming.items() if b in self._held or b in coming}
            for block in coming:
                if block not in self._held and block not in self._coming:
                    self._coming[block] = self._ahead.submit(self._decode, self.blocks[block])

    def __getitem__(self, rows: Any) -> Frames:
        """Rows by an integer, a slice or an integer array of any shape."""
        flat, shape = row_numbers(rows, len(self))
        out = np.empty((len(flat), *self.shape[1:]), np.uint8)
        with self._lock:
            block = self.block_of(flat)
            held = np.isin(block, list(self._held))
            for number in np.unique(block[held]):
                here = block == number
                out[here] = self._block(int(number))[flat[here] - self._first[number]]
            self._gather_loose(flat, np.flatnonzero(~held), out)
        return out.reshape(*shape, *self.shape[1:])

    def _block(self, number: int) -> Frames:
        frames = self._held[number]
        if frames is None:
            future = self._coming.pop(number, None)
            frames = self._held[number] = self._decode(self.blocks[number]) if future is None else future.result()
        return frames

    def _gather_loose(self, flat: IntArray, places: IntArray, out: Frames) -> None:
        """Rows of episodes that no held block has: decoded whole, as many of them together as may stay."""
        if not len(places):
            return
        episode = np.searchsorted(self._starts, flat[places], side="right") - 1
        wanted = np.unique(episode).tolist()
        wanted.sort(key=lambda number: number not in self._loose)  # before those that make way for others
        while wanted:
            if wanted[0] not in self._loose:
                self._decode_loose(wanted)
            number = wanted.pop(0)
            self._loose.move_to_end(number)
            here = places[episode == number]
            out[here] = self._loose[number][flat[here] - self._starts[number]]

    def _decode_loose(self, wanted: Sequence[int]) -> None:
        """Decode the first of these episodes, and those after it that a quarter of the buffer has room for."""
        most = self.buffer // 4
        lengths = np.cumsum([self._spans[number].length for number in wanted])
        together = wanted[: max(1, int(np.searchsorted(lengths, most, side="right")))]
        kept = sum(map(len, self._loose.values())) + int(lengths[len(together) - 1])
        while self._loose and kept > most:
            kept -= len(self._loose.popitem(last=False)[1])
        frames, begin = self._decode([self._spans[number] for number in together]), 0
        for number in together:
            # A copy: one view of what was decoded together would keep all of it.
            self._loose[number] = frames[begin : begin + self._spans[number].length].copy()
            begin += self._spans[number].length

    def _decode(self, spans: Sequence[Span]) -> Frames:
        first = np.cumsum([0, *(span.length for span in spans)])
        place = {
            span.start + i: begin + i for span, begin in zip(spans, first, strict=False) for i in range(span.length)
        }
        frames = np.empty((int(first[-1]), *self.shape[1:]), np.uint8)
        for row, frame in rgb_frames(self._contents, self.camera, spans):
            frames[place[row]] = sized(frame, self.size)
        return frames


def streams_of(frames: FrameRows) -> list[FrameStream]:
    """The streams that frames are read from, whatever is done to them; none for a frame cache."""
    if isinstance(frames, RowView):
        return [stream for part in frames.parts for stream in streams_of(part)]
    return [frames] if isinstance(frames, FrameStream) else []


def blocks_of(frames: FrameRows, rows: IntArray) -> IntArray:
    """Number of the block of each row, counted through all of `streams_of`."""
    if isinstance(frames, FrameStream):
        return frames.block_of(rows)
    if not isinstance(frames, RowView):
        raise TypeError(f"got {type(frames).__name__}, expected frames that are streamed")
    found, before = np.empty(len(rows), np.int64), 0
    for part, here, own in frames.located(rows):
        found[here] = blocks_of(part, own) + before
        before += sum(len(stream.blocks) for stream in streams_of(part))
    return found


class ShuffleBuffer:
    """Which episodes a step's windows are drawn from.

    Args:
        starts: first row of each episode that is trained on (E,).
        places: windows of each (E,).
        groups: set of each (E,), of sets with weights; all 0 else.
        shares: how much of the batch comes from each set; they add up to 1.
    """

    def __init__(
        self,
        frames: FrameRows,
        starts: IntArray,
        places: IntArray,
        groups: IntArray,
        shares: npt.NDArray[np.float64],
        seed: int,
    ) -> None:
        self._streams, self.seed, self.shares = streams_of(frames), seed, shares
        self._ends = np.cumsum([len(stream.blocks) for stream in self._streams])
        self.block = blocks_of(frames, starts)
        sizes = np.array([sum(s.length for s in block) for stream in self._streams for block in stream.blocks])
        buffer, kept = self._streams[0].buffer, places > 0
        self._blocks = [np.unique(self.block[kept & (groups == g)]) for g in range(len(shares))]
        windows = [places[groups == g].sum() for g in range(len(shares))]
        self._windows = [max(1.0, w / max(1, len(b))) for w, b in zip(windows, self._blocks, strict=True)]
        self._held = [
            max(1, min(len(b), round(share * buffer / max(1.0, sizes[b].mean() if len(b) else 1.0))))
            for b, share in zip(self._blocks, shares, strict=True)
        ]
        self._orders: dict[tuple[int, int], IntArray] = {}
        self._at: list[list[int]] = []
        for blocks, held in zip(self._blocks, self._held, strict=True):
            if held < min(FEW, len(blocks)) and processes.here().first:
                enough = FEW * round(sizes[blocks].mean())
                print(
                    f"note: data.shuffle_buffer={buffer} holds {held} of {len(blocks)} blocks of episodes, and batches "
                    f"hardly mix: {enough} or more would hold {min(FEW, len(blocks))}",
                    flush=True,
                )

    def episodes(self, step: int, batch: int) -> IntArray:
        """Indices of the episodes that step `step` may draw from; the buffer moves there."""
        held, coming = [], []
        for group, blocks in enumerate(self._blocks):
            if not len(blocks):
                continue
            if self._held[group] == len(blocks):
                held += blocks.tolist()
                continue
            first = int(step * batch * self.shares[group] / self._windows[group])
            held += [self._ordered(group, first + i) for i in range(self._held[group])]
            coming.append(self._ordered(group, first + self._held[group]))
        if [held, coming] != self._at:
            self._at = [held, coming]
            begin = 0
            for stream, end in zip(self._streams, self._ends, strict=True):
                stream.hold(
                    [b - begin for b in held if begin <= b < end], [b - begin for b in coming if begin <= b < end]
                )
                begin = int(end)
        found: IntArray = np.flatnonzero(np.isin(self.block, held))
        return found

    def _ordered(self, group: int, place: int) -> int:
        """The block at a place of the endless order."""
        epoch, i = divmod(place, len(self._blocks[group]))
        key = group, epoch
        if key not in self._orders:
            self._orders = {k: order for k, order in self._orders.items() if k[1] >= epoch - 1}
            generator = np.random.default_rng([self.seed, ORDER_STREAM, group, epoch])
            self._orders[key] = generator.permutation(self._blocks[group])
        return int(self._orders[key][i])
