"""Looking at a data set before anything is trained on it: how large its frames have to be, and how far apart.

    d_k(t, x) = max_c |o_{t+k}(x, c) - o_t(x, c)|,   M_k(t) = {x : d_k(t, x) > theta},   theta = 6 sigma, 10 to 40
    v_k(t) = sum_{x in M} d_k(t, x) / sum_{x in M} |grad o(x)|

in grey levels of 255, with sigma the camera's noise, a robust deviation of d_1 where it is smallest, and o the mean of
the two frames. v is what the brightness-constancy equation d = v grad o gives for an edge that moves by less than its
width: pixels; beyond that it saturates at a few, which is far enough.

Shapes: F frames of an episode, S side of what is looked at, at most 128 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.agreement import open_files
from playslot_rl.data.contents import Contents
from playslot_rl.data.frames import resize_frames, rgb_frames
from playslot_rl.data.metadata import stated_size
from playslot_rl.data.windows import spread_evenly
from playslot_rl.errors import DataError

Frames = npt.NDArray[np.uint8]

EPISODES: Final = 12  # that are looked at
FRAMES: Final = 240  # of each
SIZES: Final = (64, 128)
STRIDES: Final = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32)
MOVED: Final = 8  # pixels of a 64x64 frame that have to change for a pair of frames to count
DETAIL: Final = 16  # pixels that the typical motion has to cover in a frame of 64x64
FAR: Final = 1.0  # pixels of the model's frame that things typically have to move by
KEPT: Final = 12  # frames that a typical episode has to keep


class Choice(NamedTuple):
    """A setting and why."""

    value: int
    reason: str


@dataclass(frozen=True)
class Survey:
    """What was seen: the camera that was read, its stated size (H, W), frames of all episodes (E,), the width of the
    actions (0 has none), and frames of some `episodes`, uint8 (F, S, S, 3), S at most 128."""

    root: Path
    camera: str
    fps: float
    size: tuple[int, int]
    lengths: npt.NDArray[np.int64]
    action_dim: int
    episodes: list[Frames]
    noise: float

    @property
    def threshold(self) -> float:
        return min(40.0, max(10.0, 6.0 * self.noise))  # where everything moves all the time, that is no noise


def survey(root: str | Path, camera: str = "") -> Survey:
    """Look at a LeRobot v3.0 data set: all of its metadata, and the first frames of episodes spread over it.

    Raises:
        DataError: no such set, no camera, several and none named, one-frame episodes, or nothing ever moves.
    """
    files = open_files(root)
    camera = files.camera(camera)
    lengths = np.array([episode.length for episode in files.episodes], np.int64)
    if lengths.max() < 2:
        raise DataError(f"{root}: got episodes of one frame, expected videos: nothing can move from frame to frame")
    side = 128 if min(stated_size(files.features[camera])) >= 128 else 64
    episodes = _some_episodes(files, camera, side)
    actions: dict[str, Any] = files.features.get(keys.FEATURE_ACTION, {})
    width, size = int(np.prod(actions.get("shape", [0]))), stated_size(files.features[camera])
    found = Survey(files.root, camera, files.fps, size, lengths, width, episodes, _noise(episodes))
    longest = max(len(frames) for frames in episodes) - 1
    if not any(_moved(frames, lag, found.threshold).max(initial=0) for frames in episodes for lag in (1, longest)):
        raise DataError(
            f"{root}: got frames of {camera} that never change, expected videos in which something moves: "
            "name another camera by data.camera="
        )
    return found


def choose_size(seen: Survey) -> Choice:
    """Side of the frames that a model is trained on, pixels."""
    smallest = min(seen.size)
    if smallest < SIZES[-1]:
        value = 64 if smallest >= 64 else 32
        return Choice(value, f"the camera gives {seen.size[0]}x{seen.size[1]}: more would be invented")
    looked_at = max(len(frames) for frames in seen.episodes)  # of long episodes only the first FRAMES
    lag = max(1, min(int(np.median(seen.lengths)) // 10, looked_at // 2))
    moved = np.concatenate([_moved(resize_frames(frames, 64), lag, seen.threshold) for frames in seen.episodes])
    typical = float(np.median(moved[moved >= 1])) if (moved >= 1).any() else 0.0
    if typical >= DETAIL:
        return Choice(64, f"what moves within {lag} frames covers {typical:.0f} pixels of 64x64, {DETAIL} are enough")
    return Choice(128, f"what moves within {lag} frames covers {typical:.0f} pixels of 64x64, fewer than {DETAIL}")


def choose_stride(seen: Survey, size: int) -> Choice:
    """Frames between two that the model sees, so that things move from one to the next."""
    small = [resize_frames(frames, size) if frames.shape[1] != size else frames for frames in seen.episodes]
    most = max(1, int(np.median(seen.lengths)) // KEPT)
    far, stride = 0.0, 1
    for stride in (stride for stride in STRIDES if stride <= most):
        far = typical_motion(small, stride, seen.threshold)
        if far >= FAR:
            return Choice(
                stride, f"things then move by {far:.1f} pixels a frame; {seen.fps / stride:g} frames a second are left"
            )
    return Choice(
        stride,
        f"things move by {far:.1f} pixels a frame even then, less than {FAR:g}; longer strides would leave fewer than "
        f"{KEPT} frames of an episode",
    )


def typical_motion(episodes: Sequence[Frames], stride: int, threshold: float) -> float:
    """Median over the pairs of frames `stride` apart that differ of how far things moved, pixels; 0 where none does.
    Episodes are uint8 (F, S, S, 3)."""
    found = []
    for frames in episodes:
        least = MOVED * (frames.shape[1] / 64) ** 2
        for first in range(0, len(frames) - stride, 2):
            behind, ahead = frames[first].astype(np.float32), frames[first + stride].astype(np.float32)
            change = np.abs(ahead - behind).max(axis=-1)
            moved = change > threshold
            if moved.sum() >= least:
                down, right = np.gradient((ahead + behind) / 2, axis=(0, 1))
                slope = np.hypot(down, right).max(axis=-1)[moved].sum()
                found.append(float(change[moved].sum() / max(1.0, slope)))
    return float(np.median(found)) if found else 0.0


def _moved(frames: Frames, lag: int, threshold: float) -> npt.NDArray[np.int64]:
    """Pixels that change by more than the threshold from each frame to that `lag` later: (max(0, F - lag),)."""
    ahead, behind = frames[lag:], frames[: max(0, len(frames) - lag)]
    changed = [np.abs(a.astype(np.int16) - b).max(axis=-1) > threshold for a, b in zip(ahead, behind, strict=True)]
    return np.array([int(mask.sum()) for mask in changed], np.int64)


def _noise(episodes: Sequence[Frames]) -> float:
    """sigma: the median over episodes of the stillest pair's, so that no motion counts as noise."""
    found = []
    for frames in episodes:
        steps = [np.abs(b.astype(np.int16) - a) for a, b in zip(frames[:-1:4], frames[1::4], strict=False)]
        found.append(min(1.4826 * float(np.median(step)) / np.sqrt(2) for step in steps))
    return float(np.median(found))


def _some_episodes(files: Contents, camera: str, side: int) -> list[Frames]:
    long = np.flatnonzero([episode.length > 1 for episode in files.episodes]).astype(np.int64)
    found: list[Frames] = []
    for span in (files.spans[episode] for episode in spread_evenly(long, EPISODES)):
        frames = []
        for _, frame in rgb_frames(files, camera, [span]):
            frames.append(resize_frames(frame[None], side)[0])
            if len(frames) == FRAMES:
                break
        found.append(np.stack(frames))
    return found
