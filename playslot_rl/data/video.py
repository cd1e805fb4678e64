"""Decoding the videos of a LeRobot data set from beginning to end, each file once.

LeRobot's decoder opens and seeks for every query, and its import looks for a system FFmpeg and prints a long warning
without one; PyAV brings its own. `tests/data` checks that the frames are those of `LeRobotDataset`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.errors import DataError


def frames_at(path: Path, times: Sequence[float], tolerance: float) -> Iterator[npt.NDArray[np.uint8]]:
    """Frames of a video at ascending times, as pixels.

    Args:
        path: video file.
        times: seconds, ascending.
        tolerance: largest distance of a frame from its time, seconds.

    Yields:
        uint8 (H, W, 3).

    Raises:
        DataError: the video cannot be opened or decoded, or has no frame at one of the times.
    """
    for frame in decoded_at(path, times, tolerance):
        yield frame.to_ndarray(format="rgb24")


def decoded_at(path: Path, times: Sequence[float], tolerance: float) -> Iterator[Any]:
    """Frames of a video at ascending times, as PyAV's `VideoFrame`: arguments and errors of `frames_at`."""
    import av

    wanted = iter(times)
    due = next(wanted, None)
    reason = "it ends too early"
    try:
        with av.open(str(path)) as container:
            stream: Any = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                now = float(frame.pts * stream.time_base) if frame.pts is not None else -1.0
                if due is None or now > due + tolerance:
                    break
                if now >= due - tolerance:
                    yield frame
                    due = next(wanted, None)
    except (av.FFmpegError, OSError, IndexError) as error:
        reason = str(error).splitlines()[0]
    if due is not None:
        raise DataError(
            f"{path}: cannot decode the frame at {due:.3f} s ({reason}), expected a whole video of {len(times)} "
            "frames: the data set is damaged, collect or pull it again"
        )
