"""A set that a robot could have recorded: frames of any size, several cameras, actions; and runs trained on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from commands import smoke

LENGTHS = (12, 13, 12, 14, 12)
FPS = 30


def write_recordings(root: Path, cameras: tuple[str, ...] = ("top",), size: tuple[int, int] = (80, 96)) -> Path:
    """A square that the action moves, by LeRobot's own writer."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    shape = {"dtype": "image", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {f"observation.images.{name}": shape for name in cameras}
    features["action"] = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    data = LeRobotDataset.create("me/robot", fps=FPS, features=features, root=root, use_videos=False)
    draw = np.random.default_rng(0)
    for length in LENGTHS:
        at = draw.uniform(5, 40, 2)
        for _ in range(length):
            action = draw.uniform(-1, 1, 2).astype(np.float32)
            frame = draw.integers(50, 70, (*size, 3)).astype(np.uint8)
            x, y = at.astype(int)
            frame[y : y + 20, x : x + 20] = 220
            data.add_frame({**dict.fromkeys(list(features)[:-1], frame), "action": action, "task": "push"})
            at = np.clip(at + 4 * action, 0, min(size) - 20)
        data.save_episode(parallel_encoding=False)
    data.finalize()
    return root


def trained(run: Path, data: Path, *settings: str) -> Path:
    """A run of the three stages on recordings, frames of them resized, as `train-*` make it."""
    own = ("env=video", f"data.root={data}", "data.resize=true", "env.action_dim=2", *settings, f"out={run}")
    smoke("train-slots", "preset=smoke", "slots.start_from=", *own)
    smoke("train-dynamics", f"run={run}")
    smoke("train-policy", f"run={run}", f"data.demos={data}", "behaviour.labelled_demos=2")
    return run
