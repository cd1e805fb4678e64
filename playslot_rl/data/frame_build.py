"""Decoding a data set into one array: in units of some episodes, by several processes, gone on with after a kill.

    PART/frames.npy      uint8 (F, H, W, 3), as large as it will be from the beginning
    PART/units/00012     digest of the frames of unit 12, written after they are on the disk

A unit whose frames have another digest than it says (a power cut, another hand) is decoded again.

Shapes: F frames, H W image height and width.
"""

from __future__ import annotations

import contextlib
import os
import threading
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.cache import ArrayWriter
from playslot_rl.data.contents import Contents, Span, in_runs
from playslot_rl.data.frames import rgb_frames, sized
from playslot_rl.data.metadata import stated_size
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.threads import available_cores
from playslot_rl.storage.atomic import explain_write_errors, write_text

UNIT_FRAMES: Final = 2048  # frames of a unit, about: some seconds of work


@dataclass(frozen=True)
class FrameArray:
    """The array that is being made."""

    contents: Contents
    camera: str
    size: int | None
    path: Path

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(F, H, W, 3)."""
        height, width = stated_size(self.contents.features[self.camera])
        return (self.contents.rows, self.size or height, self.size or width, 3)

    @property
    def bytes(self) -> int:
        return int(np.prod(self.shape))

    def begin(self) -> None:
        """Make the file, all holes, if it is not there.

        Raises:
            OutputError: the disk is full.
        """
        with explain_write_errors(self.path):
            if not self.path.is_file() or self.path.stat().st_size < self.bytes:
                ArrayWriter(self.path, self.shape, np.uint8).close()

    def decode(self, spans: Sequence[Span]) -> str:
        """Decode some episodes to their rows; returns their digest.

        Raises:
            DataError: a frame cannot be decoded.
            OutputError: the disk is full.
        """
        digest = 0
        with (
            explain_write_errors(self.path),
            contextlib.closing(ArrayWriter(self.path, self.shape, np.uint8, begun=True)) as writer,
        ):
            for row, frame in rgb_frames(self.contents, self.camera, spans):
                pixels = sized(frame, self.size)
                writer.write(pixels[None], row)
                digest += _digest(row, pixels)
            writer.sync()
        return f"{digest:x}"

    def digest(self, spans: Sequence[Span]) -> str:
        """Of what the file holds of some episodes."""
        frames: npt.NDArray[np.uint8] = np.load(self.path, mmap_mode="r")
        return f"{sum(_digest(row, frames[row]) for span in spans for row in range(span.start, span.stop)):x}"


def _digest(row: int, pixels: npt.NDArray[np.uint8]) -> int:
    """Whatever order frames come in, their sum is the same."""
    return zlib.crc32(np.ascontiguousarray(pixels).data, row & 0xFFFFFFFF)


def build_frames(contents: Contents, camera: str, size: int | None, folder: Path, workers: int = 1) -> None:
    """Decode a data set to `folder/frames.npy`, by several processes (0: one for each core, 1: this one).

    Raises:
        DataError: a frame cannot be decoded.
        OutputError: the disk is full.
        PlaySlotError: a worker died.
    """
    array = FrameArray(replace(contents, columns={}), camera, size, folder / "frames.npy")
    array.begin()
    marks = folder / "units"
    marks.mkdir(exist_ok=True)
    missing = {}
    for number, spans in enumerate(units(contents, camera)):
        mark = marks / f"{number:05d}"
        if not mark.is_file() or mark.read_text() != array.digest(spans):
            missing[number] = spans
    count = min(workers or available_cores(), len(missing))
    for number, digest in _decoded(array, missing, count):
        write_text(marks / f"{number:05d}", digest)
    for mark in marks.iterdir():
        mark.unlink()
    marks.rmdir()


def units(contents: Contents, camera: str) -> list[list[Span]]:
    """Episodes in order, in runs of about `UNIT_FRAMES` frames; none crosses a file."""
    rows = {episode.index: episode.row for episode in contents.episodes}

    def place(span: Span) -> object:
        return contents.video_file(camera, rows.get(span.index, {})) if camera in contents.videos else span.file

    def full(run: Sequence[Span], span: Span) -> bool:
        return place(span) != place(run[-1]) or sum(s.length for s in run) + span.length > UNIT_FRAMES

    return in_runs(contents.spans, full)


def _decoded(array: FrameArray, missing: dict[int, list[Span]], workers: int) -> Iterator[tuple[int, str]]:
    if workers <= 1:
        for number, spans in missing.items():
            yield number, array.decode(spans)
        return
    import multiprocessing

    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin, (array,))
    try:
        running = {pool.submit(_work, spans): number for number, spans in missing.items()}
        for future in as_completed(running):
            yield running[future], future.result()
    except BrokenProcessPool as error:
        raise PlaySlotError(
            f"{array.path}: got a worker that died, expected it to decode; if it was killed for want of memory, lower "
            "data.workers; the same command carries on"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


_ARRAY: list[Any] = []  # of a worker: what it decodes to; sent once, not with every unit


def _begin(array: FrameArray) -> None:
    import multiprocessing
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's Ctrl-C is its own; it ends us
    _ARRAY[:] = [array]
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


def _work(spans: Sequence[Span]) -> str:
    array: FrameArray = _ARRAY[0]
    return array.decode(spans)
