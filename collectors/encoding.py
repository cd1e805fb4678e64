"""An episode as one file: arrays in an uncompressed npz, its frames as the PNGs that the data set will hold.

Frames are encoded once, where they were recorded; the export copies the bytes.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.collectors.episodes import RecordedEpisode
from playslot_rl.errors import OutputError

ARRAYS: Final = ("states", "actions", "rewards", "success")
PNG_LEVEL: Final = 6
"""Compression that LeRobot uses for stored images."""

Frames = npt.NDArray[np.uint8]


def png(frame: Frames) -> bytes:
    """PNG of a frame uint8 (H, W, 3)."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=PNG_LEVEL)
    return buffer.getvalue()


def decode_png(content: bytes) -> Frames:
    """Frame uint8 (H, W, 3) of a PNG.

    Raises:
        OSError: damaged.
    """
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image)


def encode(episode: RecordedEpisode) -> bytes:
    """Content of the episode's file."""
    images = [png(frame) for frame in episode.frames]
    arrays: dict[str, Any] = {name: getattr(episode, name) for name in ARRAYS}
    buffer = io.BytesIO()
    np.savez(
        buffer,
        numbers=np.array([episode.index, episode.seed, episode.redrawn], np.int64),
        images=np.frombuffer(b"".join(images), np.uint8),
        image_sizes=np.array([len(image) for image in images], np.int64),
        **arrays,
    )
    return buffer.getvalue()


def read(path: Path, decode: bool = True) -> tuple[RecordedEpisode, list[bytes]]:
    """The episode in a file, and the PNGs of its frames.

    Args:
        path: the file.
        decode: False leaves `frames` empty, (0,).

    Raises:
        OutputError: the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            numbers = [int(n) for n in file["numbers"]]
            arrays = {name: file[name] for name in ARRAYS}
            if "frames" in file.files:  # written by version 0.1
                frames = file["frames"]
                images = [png(frame) for frame in frames]
            else:
                ends = np.cumsum(file["image_sizes"]).tolist()
                content = file["images"].tobytes()
                images = [content[start:end] for start, end in zip([0, *ends], ends, strict=False)]
                frames = np.stack([decode_png(i) for i in images]) if decode else np.zeros(0, np.uint8)
        return RecordedEpisode(numbers[0], numbers[1], numbers[2], frames, **arrays), images
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise OutputError(
            f"{path}: got a damaged file ({error}), expected an episode; delete it and run the same command again"
        ) from error
