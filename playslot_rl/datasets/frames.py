"""Decoding every frame of a data set once: a digest of each, and the statistics of the sampled ones."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from playslot_rl.data.contents import Array, Contents, is_depth
from playslot_rl.data.frames import Decoded, decoded_frames, to_rgb
from playslot_rl.data.problems import Problems
from playslot_rl.datasets.statistics import of_frames, rounded, sampled, thinned


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
    cameras = [*contents.images, *contents.videos]
    return {camera: _scan(contents, camera, decoded_frames(contents, camera, problems)) for camera in cameras}


def _scan(contents: Contents, camera: str, frames: Iterable[tuple[int, Decoded]]) -> CameraScan:
    spans = contents.spans
    scan = CameraScan([b""] * contents.rows, [None] * len(spans), [None] * len(spans))
    depth = is_depth(contents.features[camera])
    wanted = {span.start + i: number for number, span in enumerate(spans) for i in sampled(span.length)}
    kept: dict[int, list[npt.NDArray[np.uint8]]] = {}
    for row, frame in frames:
        planes = _planes(frame)
        scan.digests[row] = _digest(planes)
        number = wanted.get(row)
        if number is None or depth or (frame is planes and planes.ndim < 3):
            continue
        kept.setdefault(number, []).append(thinned(to_rgb(frame)))
        if len(kept[number]) == len(sampled(spans[number].length)):
            taken = kept.pop(number)
            exact = scan.stats[number] = of_frames(taken)
            scan.theirs[number] = exact | {
                name: value.reshape(-1, 1, 1) / 255.0
                for name, value in rounded(pixels.reshape(-1, pixels.shape[-1]) for pixels in taken).items()
            }
    return scan


def _digest(pixels: Array) -> bytes:
    header = f"{pixels.dtype.str} {pixels.shape} ".encode()
    return hashlib.sha256(header + np.ascontiguousarray(pixels).tobytes()).digest()


def _planes(frame: Decoded) -> Array:
    """A frame as the decoder made it: a video's conversion to RGB may differ between builds of FFmpeg."""
    if isinstance(frame, np.ndarray):
        return frame
    try:
        planes: Array = frame.to_ndarray()
    except ValueError:  # a pixel format that PyAV cannot hand over
        planes = frame.to_ndarray(format="rgb24")
    return planes
