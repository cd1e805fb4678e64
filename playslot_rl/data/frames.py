"""Decoding the frames of a LeRobot data set, each file once and from its beginning to its end.

LeRobot's own reader decodes one row at a time, opens and seeks a video for every query, and its import looks for a
system FFmpeg and prints a long warning without one; PyAV brings its own. `tests/data` checks that the frames are those
of `LeRobotDataset`.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import struct
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.agreement import say_once
from playslot_rl.data.contents import Contents, Span
from playslot_rl.data.metadata import INFO_NAME, LARGEST_PICTURE, stated_size
from playslot_rl.data.places import Problems
from playslot_rl.data.tables import WRONG_COLUMN, Array
from playslot_rl.errors import DataError, first_line

ROWS_A_PIECE = 256
DAMAGED = "damaged frame"
DARK, BRIGHT, LOOKED = 4096, 0.99, 16
"""Where that share of the pixels is below `DARK` of 65535 in most of the first `LOOKED` 16-bit frames, as in depth in
millimetres, the upper eight bits are nearly black."""
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF")  # Pillow knows more, and starts programs for some

Decoded = Any  # pixels of an image, uint8 (H, W, 3), or (H, W) of a depth map; or PyAV's `VideoFrame`


def decoded_frames(
    contents: Contents, camera: str, problems: Problems, spans: Sequence[Span] | None = None
) -> Iterator[tuple[int, Decoded]]:
    """Frames of a camera with their row numbers, ascending within a file. What cannot be decoded or has another size
    than stated is left out and noted in `problems`."""
    chosen = contents.spans if spans is None else spans
    read = _video_frames if camera in contents.videos else _image_frames
    yield from read(contents, camera, chosen, problems)


def rgb_frames(
    contents: Contents, camera: str, spans: Sequence[Span] | None = None
) -> Iterator[tuple[int, npt.NDArray[np.uint8]]]:
    """Frames as pixels, uint8 (H, W, 3), with their row numbers; arguments of `decoded_frames`.

    Raises:
        DataError: a frame cannot be decoded, or has another size than stated.
    """
    problems, deep = Problems(), list[float]()
    for row, frame in decoded_frames(contents, camera, problems, spans):
        if problems.errors:
            break
        if len(deep) < LOOKED and getattr(frame, "dtype", None) == np.uint16:
            deep.append(float(np.quantile(frame, BRIGHT)))
        yield row, to_rgb(frame)
    if deep and 0 < np.median(deep) < DARK:
        say_once(
            f"note: {contents.name}: got pictures of 16 bits below {DARK} from {camera}, of which the upper eight are "
            "nearly black: scale them (depth to what the robot's work spans), or choose another by data.camera="
        )
    if problems.errors:
        said = problems.errors[0]
        cure = "" if "the data set" in said else "; the data set is damaged, collect or pull it again"
        raise DataError(f"a frame of {camera} cannot be decoded: {said}{cure}")


def to_rgb(frame: Decoded) -> npt.NDArray[np.uint8]:
    """Pixels of a decoded frame, uint8 (H, W, 3); of 16 bits the upper eight. A DataError for other numbers a pixel."""
    if not isinstance(frame, np.ndarray):
        frame = frame.to_ndarray(format="rgb24")
    if frame.ndim == 2 and frame.dtype not in (np.uint8, np.uint16):
        raise DataError(f"got a picture of {frame.dtype}, expected colours, or grey of 8 or 16 bits")
    if frame.ndim == 2:
        grey = frame if frame.dtype == np.uint8 else (frame >> 8).astype(np.uint8)
        frame = np.repeat(grey[..., None], 3, axis=-1)
    pixels: npt.NDArray[np.uint8] = frame
    return pixels


def resize_frames(frames: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """Resize whole frames by area averaging: uint8 (n, H, W, 3) to (n, size, size, 3)."""
    from PIL import Image

    return np.stack([np.asarray(Image.fromarray(f).resize((size, size), Image.Resampling.BOX)) for f in frames])


def sized(frame: npt.NDArray[np.uint8], size: int | None) -> npt.NDArray[np.uint8]:
    """A frame (H, W, 3) as a model's, (size, size, 3); None keeps its size."""
    if size is None or frame.shape[:2] == (size, size):
        return frame
    resized: npt.NDArray[np.uint8] = resize_frames(frame[None], size)[0]
    return resized


def _image_frames(
    contents: Contents, camera: str, spans: Sequence[Span], problems: Problems
) -> Iterator[tuple[int, Decoded]]:
    import pyarrow as pa

    wanted = np.zeros(contents.rows, bool)
    for span in spans:
        wanted[span.start : span.stop] = True
    decode = functools.partial(_decode_image, stated_size(contents.features[camera]))
    row = 0
    # Decoding PNG releases the interpreter lock; two threads suffice to keep one core busy with it.
    with ThreadPoolExecutor(2) as pool:
        for path, rows in zip(contents.data_files, contents.file_rows, strict=True):
            begin, row = row, row + rows
            if not wanted[begin:row].any():
                continue
            for first, cells in _stored_images(contents, path, camera, wanted[begin:row], problems):
                numbers = (first + np.flatnonzero(wanted[begin + first : begin + first + len(cells)])).tolist()
                chosen = cells.take(pa.array([number - first for number in numbers], pa.int64())).to_pylist()
                for number, result in zip(numbers, pool.map(decode, chosen), strict=True):
                    if not isinstance(result, str):
                        yield begin + number, result
                        continue
                    problems.error(DAMAGED, f"{path}: row {number}, {camera}: {result}")


def _stored_images(
    contents: Contents, path: Path, camera: str, wanted: npt.NDArray[np.bool_], problems: Problems
) -> Iterator[tuple[int, Any]]:
    """Pieces of a file's column with the number of their first row; row groups without a wanted row are not read."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(contents.opened(path)) as file:
        column = file.schema_arrow.field(camera).type if file.schema_arrow.names.count(camera) == 1 else None
        if column is None or "bytes" not in {column.field(i).name for i in range(column.num_fields)}:
            problems.error(WRONG_COLUMN, f"{path}: got no column {camera} of images, expected the camera's frames")
            return
        counts = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        ends = np.cumsum(counts).tolist()
        needed = [bool(wanted[end - count : end].any()) for count, end in zip(counts, ends, strict=True)]
        for some, run in itertools.groupby(range(len(counts)), key=needed.__getitem__):
            groups = list(run)
            if not some:
                continue
            first = ends[groups[0]] - counts[groups[0]]
            for batch in file.iter_batches(ROWS_A_PIECE, row_groups=groups, columns=[camera]):
                yield first, batch.column(0)
                first += len(batch)


def _decode_image(size: tuple[int, int], cell: dict[str, Any] | None) -> Array | str:
    """Pixels of a stored image, (H, W, 3) uint8 for colours, or what is wrong with it: its header is read first, and
    nothing is decoded that has another size (H, W) than stated."""
    from PIL import Image, UnidentifiedImageError

    expected = "expected a PNG or JPEG image"
    try:
        if cell is None:
            return f"cannot be decoded (no image), {expected}"
        if not cell["bytes"]:  # a picture exchanged in place would leave the caches as they are
            return "got no more than a file's name, expected the picture itself among the rows of the data set"
        with Image.open(io.BytesIO(cell["bytes"]), formats=FORMATS) as image:
            got = (image.height, image.width)
            if got != size:
                return f"got {got}, expected {size} as stated"
            one_number = image.mode.startswith(("I", "F"))
            return np.asarray(image if one_number else image.convert("RGB"))
    except UnidentifiedImageError:
        return f"cannot be decoded (not an image), {expected}"
    except Image.DecompressionBombError:
        return f"got a picture of more than {Image.MAX_IMAGE_PIXELS} pixels, expected {size} as stated"
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, AttributeError, EOFError, struct.error) as error:
        return f"cannot be decoded ({' '.join(str(error).split())[:80] or type(error).__name__}), {expected}"


def _video_frames(
    contents: Contents, camera: str, spans: Sequence[Span], problems: Problems
) -> Iterator[tuple[int, Decoded]]:
    rows = {span.index: span for span in spans}
    files: dict[Path, list[tuple[float, Span]]] = {}
    for episode in contents.episodes:
        if episode.index not in rows:
            continue
        path, place = contents.video_file(camera, episode.row), contents.video_times(camera, episode.row)
        if path is None or place is None:
            problems.error(DAMAGED, f"episode {episode.index}: got no place of {camera} in meta/episodes, expected one")
            continue
        files.setdefault(path, []).append((place[0], rows[episode.index]))
    size = stated_size(contents.features[camera])
    for path, places in files.items():
        if not contents.holds(path):
            problems.error("missing video", f"{path}: got no such file, expected the frames of {len(places)} episodes")
            continue
        places.sort(key=lambda place: place[0])
        numbers = (span.start + i for _, span in places for i in range(span.length))
        times = [begin + i / contents.fps for begin, span in places for i in range(span.length)]
        try:
            for row, frame in zip(numbers, _frames_at(contents, path, times, 0.25 / contents.fps), strict=False):
                got = (frame.height, frame.width)
                if got != size:
                    problems.error(DAMAGED, f"{path}: {camera}: got frames of {got}, expected {size} as stated")
                    break
                yield row, frame
        except DataError as error:
            problems.error(DAMAGED, str(error))


def _frames_at(contents: Contents, path: Path, times: Sequence[float], tolerance: float) -> Iterator[Any]:
    """Frames of a video at ascending times, seconds; a DataError where it has none at one of them."""
    import av

    # A video without an index may be sought past what is wanted; then it is read from its beginning.
    for seek in (True, False) if times[0] > tolerance else (False,):
        number, reason = 0, "it ends too early"
        try:
            for now, frame in _decoded_from(contents.opened(path), times[0] if seek else 0.0):
                if number == len(times) or now > times[number] + tolerance:
                    break
                if now >= times[number] - tolerance:
                    yield frame
                    number += 1
        except (av.FFmpegError, OSError, IndexError) as error:
            reason = first_line(error)
        if number:
            break
    if number < len(times):
        rate = _own_rate(contents.opened(path))
        if abs(rate / contents.fps - 1) > 0.1:  # frames that are missing change it by less
            raise DataError(
                f"{path}: got a video of {rate:g} frames a second, expected {contents.fps:g} as in {INFO_NAME}: make "
                "the data set again with one rate for both"
            )
        raise DataError(
            f"{path}: cannot decode the frame at {times[number]:.3f} s ({reason}), expected a whole video of "
            f"{len(times)} frames: the data set is damaged, collect or pull it again"
        )


def _own_rate(source: Any) -> float:
    """Frames a second of a video, as it says; NaN where it does not."""
    import av

    try:
        with av.open(str(source) if isinstance(source, Path) else source) as container:
            return float(container.streams.video[0].average_rate or math.nan)
    except (av.FFmpegError, OSError, IndexError):
        return math.nan


def _decoded_from(source: Any, begin: float) -> Iterator[tuple[float, Any]]:
    """Time, seconds, and frame of a video from the last key frame up to `begin` on."""
    import av

    with av.open(str(source) if isinstance(source, Path) else source) as container:
        stream: Any = container.streams.video[0]
        if stream.width * stream.height > LARGEST_PICTURE:  # as its header says: nothing has been decoded
            raise DataError(f"{source}: got frames of {stream.height}x{stream.width}, expected fewer pixels")
        stream.thread_type = "AUTO"
        if begin > 0:
            container.seek(int(begin / stream.time_base), stream=stream)
        for frame in container.decode(stream):
            yield (float(frame.pts * stream.time_base) if frame.pts is not None else -1.0), frame
