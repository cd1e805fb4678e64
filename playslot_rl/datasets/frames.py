"""Decoding every frame of a data set once: a digest of each, and the statistics of the sampled ones."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.video import decoded_at
from playslot_rl.datasets.contents import Array, Contents, Span
from playslot_rl.datasets.problems import Problems
from playslot_rl.datasets.statistics import is_depth, of_frames, rounded, sampled, thinned
from playslot_rl.errors import DataError

ROWS_A_PIECE = 256
DAMAGED = "damaged frame"


@dataclass
class CameraScan:
    """One camera's frames.

    Attributes:
        digests: of the decoded pixels of each row (F); empty where a frame cannot be decoded.
        stats: of each span, from the frames that LeRobot would sample; None for depth maps and damaged episodes.
        theirs: the same with LeRobot's rounding of mean and standard deviation.
    """

    digests: list[bytes]
    stats: list[dict[str, Array] | None] = field(default_factory=list)
    theirs: list[dict[str, Array] | None] = field(default_factory=list)


def scan_frames(contents: Contents, problems: Problems) -> dict[str, CameraScan]:
    """Decode all frames of all cameras; what cannot be decoded, or has another size, is noted in `problems`."""
    scans = {}
    for camera in contents.images:
        frames = _images(contents, camera, problems)
        scans[camera] = _scan(contents, (item for file in frames for item in file))
    for camera in contents.videos:
        scans[camera] = _scan(contents, _video(contents, camera, problems))
    return scans


Decoded = tuple[int, bytes, "npt.NDArray[np.uint8] | None"]
"""Row, digest, and pixels (H, W, 3) or None where nobody needs them."""


def _scan(contents: Contents, frames: Iterator[Decoded]) -> CameraScan:
    spans = len(contents.spans)
    scan = CameraScan([b""] * contents.rows, [None] * spans, [None] * spans)
    wanted = _wanted(contents.spans)
    kept: dict[int, list[npt.NDArray[np.uint8]]] = {}
    for row, digest, pixels in frames:
        scan.digests[row] = digest
        number = wanted.get(row)
        if number is None or pixels is None:
            continue
        kept.setdefault(number, []).append(thinned(pixels))
        if len(kept[number]) == len(sampled(contents.spans[number].length)):
            taken = kept.pop(number)
            exact = scan.stats[number] = of_frames(taken)
            scan.theirs[number] = exact | {
                name: value.reshape(-1, 1, 1) / 255.0
                for name, value in rounded(frame.reshape(-1, frame.shape[-1]) for frame in taken).items()
            }
    return scan


def _wanted(spans: Sequence[Span]) -> dict[int, int]:
    """Row -> number of the span whose statistics it enters."""
    return {span.start + i: number for number, span in enumerate(spans) for i in sampled(span.length)}


def stated_size(feature: dict[str, Any]) -> tuple[int, int]:
    """(H, W) that a camera feature states, whichever way round its shape is."""
    shape, names = feature["shape"], feature.get("names") or [""]
    channels_first = names[0] in ("channel", "channels") or (len(shape) == 3 and shape[2] not in (1, 3, 4))
    height, width = shape[1:3] if channels_first else shape[:2]
    return int(height), int(width)


def _digest(pixels: Array) -> bytes:
    header = f"{pixels.dtype.str} {pixels.shape} ".encode()
    return hashlib.sha256(header + np.ascontiguousarray(pixels).tobytes()).digest()


def _images(contents: Contents, camera: str, problems: Problems) -> Iterator[Iterator[Decoded]]:
    import pyarrow.parquet as pq

    begin = 0
    # Decoding PNG and hashing release the interpreter lock; two threads suffice to keep one core busy with them.
    with ThreadPoolExecutor(2) as pool:
        for path, rows in zip(contents.data_files, contents.file_rows, strict=True):
            file = pq.ParquetFile(path)
            if camera not in file.schema_arrow.names:
                problems.error("missing column", f"{path}: got no column {camera}, expected the camera's frames")
            else:
                yield _image_rows(contents, camera, file, path, begin, pool, problems)
            begin += rows


def _image_rows(
    contents: Contents, camera: str, file: Any, path: Path, begin: int, pool: ThreadPoolExecutor, problems: Problems
) -> Iterator[Decoded]:
    size, depth = stated_size(contents.features[camera]), is_depth(contents.features[camera])

    def decode(cell: dict[str, Any] | None) -> Array | str:
        return decode_image(contents.root, cell)

    row = begin
    for batch in file.iter_batches(ROWS_A_PIECE, columns=[camera]):
        for result in pool.map(decode, batch.column(0).to_pylist()):
            if isinstance(result, str):
                where = f"{path}: row {row - begin}, {camera}"
                problems.error(DAMAGED, f"{where}: cannot be decoded ({result}), expected a PNG or JPEG image")
            elif result.shape[:2] != size:
                problems.error(
                    DAMAGED, f"{path}: row {row - begin}, {camera}: got {result.shape[:2]}, expected {size} as stated"
                )
            else:
                rgb = result.astype(np.uint8, copy=False) if not depth and result.ndim == 3 else None
                yield row, _digest(result), rgb
            row += 1


def decode_image(root: Path, cell: dict[str, Any] | None) -> Array | str:
    """Pixels of a stored image, (H, W, 3) uint8 for colours, or why it cannot be decoded."""
    from PIL import Image, UnidentifiedImageError

    try:
        if cell is None:
            return "no image"
        content = cell["bytes"] if cell.get("bytes") else (root / str(cell["path"])).read_bytes()
        with Image.open(io.BytesIO(content)) as image:
            depth = image.mode.startswith(("I", "F"))
            return np.asarray(image if depth else image.convert("RGB"))
    except UnidentifiedImageError:
        return "not an image"
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, AttributeError) as error:
        return " ".join(str(error).split())[:80] or type(error).__name__


def _video(contents: Contents, camera: str, problems: Problems) -> Iterator[Decoded]:
    rows = {span.index: span for span in contents.spans}
    files: dict[Path, list[tuple[float, Span]]] = {}
    for episode in contents.episodes:
        span = rows.get(episode.index)
        try:
            path = contents.video_file(camera, episode.row)
            begin = float(episode.row[f"videos/{camera}/from_timestamp"])
        except (KeyError, TypeError, ValueError):
            problems.error(DAMAGED, f"episode {episode.index}: got no place of {camera} in meta/episodes, expected one")
            continue
        if span is not None:
            files.setdefault(path, []).append((begin, span))
    for path, places in files.items():
        yield from _video_file(contents, camera, path, sorted(places, key=lambda place: place[0]), problems)


def _video_file(
    contents: Contents, camera: str, path: Path, places: Sequence[tuple[float, Span]], problems: Problems
) -> Iterator[Decoded]:
    size, depth = stated_size(contents.features[camera]), is_depth(contents.features[camera])
    wanted = _wanted([span for _, span in places])
    rows = [span.start + i for _, span in places for i in range(span.length)]
    times = [begin + i / contents.fps for begin, span in places for i in range(span.length)]
    if not path.is_file():
        problems.error("missing video", f"{path}: got no such file, expected the frames of {len(places)} episodes")
        return
    try:
        for row, frame in zip(rows, decoded_at(path, times, 0.25 / contents.fps), strict=False):
            if (frame.height, frame.width) != size:
                got = (frame.height, frame.width)
                problems.error(DAMAGED, f"{path}: {camera}: got frames of {got}, expected {size} as stated")
                return
            rgb = frame.to_ndarray(format="rgb24") if row in wanted and not depth else None
            yield row, _digest(_planes(frame)), rgb
    except DataError as error:
        problems.error(DAMAGED, str(error))


def _planes(frame: Any) -> Array:
    """A video frame as the decoder made it: the conversion to RGB may differ between builds of FFmpeg."""
    try:
        planes: Array = frame.to_ndarray()
    except ValueError:  # a pixel format that PyAV cannot hand over
        planes = frame.to_ndarray(format="rgb24")
    return planes
