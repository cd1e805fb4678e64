"""A foreign data set with features of one to three dimensions, of every kind, written with LeRobot itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

CAMERA = "observation.images.top"
SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "height": ("float32", (1,)),
    "joints": ("float32", (3,)),
    "pose": ("float32", (4, 4)),
    "forces": ("float64", (2, 3, 4)),
    "counts": ("int64", (2, 3)),
    "closed": ("bool", (1,)),
    "touched": ("bool", (2, 2)),
    "words": ("string", (1,)),
}


def values(name: str, frames: int, seed: int = 0) -> np.ndarray[Any, Any]:
    """Of a feature in every frame, (n, *shape)."""
    dtype, shape = SHAPES[name]
    generator = np.random.default_rng([seed, len(name)])
    if dtype == "string":
        return np.array([f"word {t}" for t in range(frames)])
    if dtype == "bool":
        return generator.integers(0, 2, (frames, *shape)).astype(bool)
    if dtype == "int64":
        return generator.integers(-5, 9, (frames, *shape))
    return generator.normal(3, 2, (frames, *shape)).astype(dtype)


def write_features(root: Path, lengths: tuple[int, ...] = (8, 5)) -> Path:
    """Episodes of such features and of noise, 16x16, in PNG."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {n: {"dtype": d, "shape": s, "names": None} for n, (d, s) in SHAPES.items()}
    features[CAMERA] = {"dtype": "image", "shape": (16, 16, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create("me/features", fps=10, features=features, root=root, use_videos=False)
    generator = np.random.default_rng(1)
    for episode, length in enumerate(lengths):
        rows = {name: values(name, length, episode) for name in SHAPES}
        for t in range(length):
            row = {name: str(rows[name][t]) if dtype == "string" else rows[name][t] for name, (dtype, _) in
                   SHAPES.items()}  # fmt: skip
            dataset.add_frame({**row, CAMERA: generator.integers(0, 256, (16, 16, 3), np.uint8), "task": "look"})
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root
