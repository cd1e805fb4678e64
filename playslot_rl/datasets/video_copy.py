"""Copying the videos of single episodes without decoding them, so that not a pixel changes.

LeRobot encodes each episode by itself and joins the streams, so an episode begins at a key frame and its packets can
be copied. Where it does not (LeRobot's own split encodes what is left as one stream), the whole file is copied and the
episode goes on to lie in the middle of it.

Note: LeRobot's `split_dataset` and `delete_episodes` encode again, which loses quality and changes every frame.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.errors import DataError

DEFAULT_SIZE_MB: Final = 200
DEFAULT_FILES: Final = 1000


@dataclass(frozen=True)
class Packets:
    """The compressed frames of a file, in the order of decoding.

    Attributes:
        times: seconds, (n,).
        keys: whether decoding can begin there, (n,).
    """

    times: npt.NDArray[np.float64]
    keys: npt.NDArray[np.bool_]


@dataclass
class VideoCopier:
    """Writes the files of one camera of a new data set.

    Attributes:
        root: the new data set.
        camera: feature.
        template: path of a file below `root`, with `video_key`, `chunk_index` and `file_index`.
        fps: frames a second.
        limit: bytes after which the next file begins.
        files: files in a folder.
    """

    root: Path
    camera: str
    template: str
    fps: float
    limit: int = DEFAULT_SIZE_MB * 2**20
    files: int = DEFAULT_FILES
    _number: int = -1
    _frames: int = 0
    _bytes: int = 0
    _out: Any = None
    _stream: Any = None
    _codec: tuple[Any, ...] = ()
    _last_dts: int = -(2**62)
    _copied: dict[Path, int] = field(default_factory=dict)
    _packets: dict[Path, Packets] = field(default_factory=dict)
    _source: _Source | None = None

    def copy(self, path: Path, begin: float, length: int) -> dict[str, Any]:
        """Copy an episode.

        Args:
            path: source file.
            begin: seconds of the episode's first frame in it.
            length: frames.

        Returns:
            The new `chunk_index`, `file_index`, `from_timestamp` and `to_timestamp`, as in `meta/episodes`.

        Raises:
            DataError: the file has no such frames.
        """
        import av

        try:
            if path not in self._packets:
                self._packets = {path: _packets(path)}
            first = self._cut(path, begin, length)
            if first is None:
                return self._copy_whole(path, begin, length)
            return self._copy_packets(path, first, begin, length)
        except (av.FFmpegError, OSError, IndexError) as error:
            if isinstance(error, OSError) and not isinstance(error, av.FFmpegError):
                raise
            raise DataError(
                f"{path}: got {str(error).splitlines()[0]}, expected a whole video; run `playslot dataset verify`"
            ) from error

    def close(self) -> None:
        """Finish the last file."""
        if self._out is not None:
            self._out.close()
            self._out = None
        if self._source is not None:
            self._source.close()
            self._source = None

    def _cut(self, path: Path, begin: float, length: int) -> int | None:
        """Number of the episode's first packet, or None where its packets are not a piece by themselves."""
        packets, half = self._packets[path], 0.5 / self.fps
        times = packets.times
        inside = np.flatnonzero((times >= begin - half) & (times < begin + (length - 0.5) / self.fps))
        if len(inside) != length:
            raise DataError(
                f"{path}: got {len(inside)} frames from {begin:.3f} s, expected {length}; run `playslot dataset verify`"
            )
        first, last = int(inside[0]), int(inside[-1])
        whole = last - first + 1 == length and bool(packets.keys[first])
        closed = last + 1 == len(times) or bool(packets.keys[last + 1])
        return first if whole and closed else None

    def _copy_packets(self, path: Path, first: int, begin: float, length: int) -> dict[str, Any]:
        source = self._open(path)
        stream = source.stream
        codec = _codec(stream)
        if self._out is None or self._bytes >= self.limit or codec != self._codec:
            self._next(stream, codec)
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
            self.close()
            self._number += 1
            number = self._copied[path] = self._number
            target = self._path()
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
        return self._place(begin, length, number)

    def _open(self, path: Path) -> _Source:
        if self._source is None or self._source.path != path:
            if self._source is not None:
                self._source.close()
            self._source = _Source(path)
        return self._source

    def _next(self, template: Any, codec: tuple[Any, ...]) -> None:
        import av

        if self._out is not None:
            self._out.close()
        self._number += 1
        self._frames, self._bytes, self._codec, self._last_dts = 0, 0, codec, -(2**62)
        target = self._path()
        target.parent.mkdir(parents=True, exist_ok=True)
        self._out = av.open(str(target), "w", format="mp4")
        self._stream = self._out.add_stream_from_template(template)
        self._stream.time_base = template.time_base

    def _path(self) -> Path:
        chunk, file = divmod(self._number, self.files)
        return self.root / self.template.format(video_key=self.camera, chunk_index=chunk, file_index=file)

    def _place(self, start: float, length: int, number: int | None = None) -> dict[str, Any]:
        chunk, file = divmod(self._number if number is None else number, self.files)
        return {
            f"videos/{self.camera}/chunk_index": chunk,
            f"videos/{self.camera}/file_index": file,
            f"videos/{self.camera}/from_timestamp": start,
            f"videos/{self.camera}/to_timestamp": start + length / self.fps,
        }


class _Source:
    """A file being read packet by packet. Seeking goes by times of key frames; counting packets is exact."""

    def __init__(self, path: Path) -> None:
        import av

        self.path, self._container = path, av.open(str(path))
        self.stream: Any = self._container.streams.video[0]
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
    """Frames in a video file, counted in its packets.

    Raises:
        DataError: it cannot be opened.
    """
    import av

    try:
        return len(_packets(path).times)
    except (av.FFmpegError, OSError, IndexError) as error:
        raise DataError(f"{path}: got {str(error).splitlines()[0]}, expected a video") from error


def _packets(path: Path) -> Packets:
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        base = stream.time_base or Fraction(1)
        found = [(float((p.pts or 0) * base), bool(p.is_keyframe)) for p in container.demux(stream) if p.size]
    return Packets(np.array([time for time, _ in found]), np.array([key for _, key in found], np.bool_))


def _codec(stream: Any) -> tuple[Any, ...]:
    """What has to be equal for two streams to go into one file."""
    context = stream.codec_context
    extra = bytes(context.extradata or b"")
    return (context.name, context.width, context.height, context.pix_fmt, stream.time_base, extra)
