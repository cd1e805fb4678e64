"""Foreign data sets, written with LeRobot itself."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

LENGTHS = (5, 3, 7)


def foreign_frames(size: int = 32) -> list[np.ndarray[Any, Any]]:
    """Random smooth colours: uint8 (T, H, W, 3) for each episode."""
    generator = np.random.default_rng(0)
    coarse = [generator.integers(0, 256, (n, 4, 4, 3), np.uint8) for n in LENGTHS]
    return [c.repeat(size // 4, 1).repeat(size // 4, 2) for c in coarse]


def write_foreign(
    root: Path, dtype: str, size: int = 32, cameras: tuple[str, ...] = ("top",), die: bool = False, codec: str = "h264"
) -> Path:
    """A data set that is not ours: other names, no seed, no last-observation flag."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {
        f"observation.images.{name}": {
            "dtype": dtype,
            "shape": (size, size, 3),
            "names": ["height", "width", "channels"],
        }
        for name in cameras
    }
    features["action"] = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    lossless = {"vcodec": "h264", "pix_fmt": "yuv444p", "crf": 0}
    encoder = RGBEncoderConfig(**lossless if codec == "h264" else {"vcodec": codec}) if dtype == "video" else None
    dataset = LeRobotDataset.create("me/foreign", fps=10, features=features, root=root, use_videos=dtype == "video",
                                    rgb_encoder=encoder)  # fmt: skip
    for episode in foreign_frames(size):
        for t, frame in enumerate(episode):
            row: dict[str, Any] = {f"observation.images.{name}": frame for name in cameras}
            dataset.add_frame(row | {"action": np.array([t, -t], np.float32), "task": "push"})
        dataset.save_episode(parallel_encoding=False)  # its processes would each import LeRobot again
    if die:
        os._exit(0)  # as a kill would: no destructor finalises
    dataset.finalize()
    return root
