"""Copying the videos of single episodes without decoding them, so that not a pixel changes.

LeRobot encodes each episode by itself and joins the streams, so an episode begins at a key frame and its packets can
be copied. Where it does not (LeRobot's own split encodes what is left as one stream), the whole file is copied and the
episode goes on to lie in the middle of it.

Note: LeRobot's `split_dataset` and `delete_episodes` encode again, which loses quality and changes every frame.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.data.metadata import VIDEO_PATH
from playslot_rl.errors import DataError, first_line


def video_place(camera: str, chunk: int, file: int, begin: float, end: float) -> dict[str, Any]:
    """Where an episode's video lies, seconds, as in `meta/episodes`."""
    values = {"chunk_index": chunk, "file_index": file, "from_timestamp": begin, "to_timestamp": end}
    return {f"videos/{camera}/{name}": value for name, value in values.items()}


class VideoCopier:
    """Writes the files of one camera of a new data set; after `limit` bytes the next one begins."""

    def __init__(self, root: Path, camera: str, fps: float, limit: int, files: int) -> None:
        self.root, self.camera, self.fps, self.limit, self.files = root, camera, fps, limit, files
        self._number = -1
        self._frames = self._bytes = 0
        self._out: Any = None
        self._stream: Any = None
        self._codec: tuple[Any, ...] = ()
        self._last_dts = -(2**62)
        self._copied: dict[Path, int] = {}
        self._source: _Source | None = None

    def copy(self, path: Path, begin: float, length: int) -> dict[str, Any]:
        """Copy an episode, whose first frame is at `begin` seconds; returns its new places, as in `meta/episodes`.

        Raises:
            DataError: the file has no such frames.
        """
        import av

        try:
            if self._source is None or self._source.path != path:
                if self._source is not None:
                    self._source.close()
                self._source = _Source(path)
            first = self._cut(self._source, begin, length)
            if first is None:
                return self._copy_whole(path, begin, length)
            return self._copy_packets(self._source, first, begin, length)
        except (av.FFmpegError, IndexError) as error:
            raise DataError(
                f"{path}: got {first_line(error)}, expected a whole video; run `playslot dataset verify`"
            ) from error

    def close(self) -> None:
        self._finish()
        if self._source is not None:
            self._source.close()
            self._source = None

    def _finish(self) -> None:
        if self._out is not None:
            self._out.close()
            self._out = None

    def _cut(self, source: _Source, begin: float, length: int) -> int | None:
        """Number of the episode's first packet, or None where its packets are not a piece by themselves."""
        times, half = source.times, 0.5 / self.fps
        inside = np.flatnonzero((times >= begin - half) & (times < begin + (length - 0.5) / self.fps))
        if len(inside) != length:
            raise DataError(
                f"{source.path}: got {len(inside)} frames from {begin:.3f} s, expected {length}; "
                "run `playslot dataset verify`"
            )
        first, last = int(inside[0]), int(inside[-1])
        whole = last - first + 1 == length and bool(source.keys[first])
        closed = last + 1 == len(times) or bool(source.keys[last + 1])
        return first if whole and closed else None

    def _copy_packets(self, source: _Source, first: int, begin: float, length: int) -> dict[str, Any]:
        stream, context = source.stream, source.stream.codec_context
        # What has to be equal for two streams to go into one file.
        extra = bytes(context.extradata or b"")
        codec = (context.name, context.width, context.height, context.pix_fmt, stream.time_base, extra)
        if self._out is None or self._bytes >= self.limit or codec != self._codec:
            self._next(stream)
            self._codec = codec
        start = self._frames / self.fps
        base = float(stream.time_base)
        shift = round(start / base) - round(begin / base)
        for packet in source.packets(first, length):
            packet.pts += shift
            packet.dts = min(packet.pts, max(self._last_dts + 1, packet.dts + shift))
            self._last_dts = packet.dts
            packet.stream = self._stream
            self._bytes += packet.size  # the file itself lags behind: the muxer buffers
            self._out.mux_one(packet)
        self._frames += length
        return self._place(start, length)

    def _copy_whole(self, path: Path, begin: float, length: int) -> dict[str, Any]:
        number = self._copied.get(path)
        if number is None:
            self._finish()
            target = self._next_path()
            number = self._copied[path] = self._number
            shutil.copyfile(path, target)
        return self._place(begin, length, number)

    def _next(self, template: Any) -> None:
        import av

        self._finish()
        self._frames, self._bytes, self._last_dts = 0, 0, -(2**62)
        self._out = av.open(str(self._next_path()), "w", format="mp4")
        self._stream = self._out.add_stream_from_template(template, opaque=True)
        self._stream.time_base = template.time_base

    def _next_path(self) -> Path:
        self._number += 1
        chunk, file = divmod(self._number, self.files)
        target = self.root / VIDEO_PATH.format(video_key=self.camera, chunk_index=chunk, file_index=file)
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def _place(self, start: float, length: int, number: int | None = None) -> dict[str, Any]:
        chunk, file = divmod(self._number if number is None else number, self.files)
        return video_place(self.camera, chunk, file, start, start + length / self.fps)


class _Source:
    """A file being read packet by packet. Seeking goes by times of key frames; counting packets is exact.

    Attributes:
        times: of its packets (compressed frames), in the order of decoding, seconds, float64 (n,).
        keys: whether decoding can begin there, bool (n,).
    """

    def __init__(self, path: Path) -> None:
        import av

        self.path, self._container = path, av.open(str(path))
        self.stream: Any = self._container.streams.video[0]
        base = self.stream.time_base or Fraction(1)
        self._rewind()
        found = [(float((packet.pts or 0) * base), bool(packet.is_keyframe)) for packet in self._left]
        self.times = np.array([time for time, _ in found])
        self.keys = np.array([key for _, key in found], np.bool_)
        self._rewind()

    def _rewind(self) -> None:
        self._container.seek(0)
        self._left: Iterator[Any] = (packet for packet in self._container.demux(self.stream) if packet.size)
        self._passed = 0

    def packets(self, first: int, length: int) -> Iterator[Any]:
        """Packets number `first` to `first + length`; quick where each call begins after the last one's end."""
        if first < self._passed:
            self._rewind()
        for packet in self._left:
            number, self._passed = self._passed, self._passed + 1
            if number >= first:
                yield packet
            if self._passed >= first + length:
                return

    def close(self) -> None:
        self._container.close()


def frame_count(path: Path) -> int:
    """Frames in a video file, counted in its packets; a DataError where it cannot be opened."""
    import av

    try:
        with contextlib.closing(_Source(path)) as source:
            return len(source.times)
    except (av.FFmpegError, OSError, IndexError) as error:
        raise DataError(f"{path}: got {first_line(error)}, expected a video") from error
