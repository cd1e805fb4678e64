"""A robot's data set as people record them: LeRobot's own writer, joints in degrees, a gripper, no simulator."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

CAMERA = "observation.images.top"
NAMES = ["shoulder.pos", "lift.pos", "elbow.pos", "wrist.pos", "roll.pos", "gripper.pos"]
CONSTANT, VALUE = 3, 7.3
"""A joint that never moves, and where it stands."""
OUTLIER, GLITCH = 4, 5000.0
"""A joint with one reading that is none."""
EPISODES, LENGTH = 6, 30


def robot_actions(dtype: str = "float32") -> list[np.ndarray[Any, Any]]:
    """Actions (T, 6) of each episode."""
    generator, found = np.random.default_rng(3), []
    for episode in range(EPISODES):
        t = np.arange(LENGTH)[:, None] / LENGTH
        phase = generator.uniform(0, 6, 6)
        a = np.sin(6 * t + phase) * np.array([90, 45, 120, 0, 10, 50]) + np.array([0, -30, 10, VALUE, 0, 50])
        if episode == 1:
            a[9, OUTLIER] = GLITCH
        found.append(a.astype(dtype))
    return found


def write_robot(
    root: Path,
    actions: list[np.ndarray[Any, Any]] | None = None,
    names: Any = None,
    robot: str | None = "arm",
    size: int = 64,
    labelled: bool = True,
    states: bool = False,
    tasks: Sequence[str] = ("reach",),
) -> Path:
    """A data set of a square that moves with the first two joints, by LeRobot's writer; its actions, if `labelled`,
    and as many `states`; its first episodes are of the first of the tasks, and so on."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    actions = robot_actions() if actions is None else actions
    width, dtype = actions[0].shape[1], str(actions[0].dtype)
    features: dict[str, Any] = {
        CAMERA: {
            "dtype": "image",
            "shape": (size, size, 3),
            "names": ["height", "width", "channels"],
        },
        "action": {"dtype": dtype, "shape": (width,), "names": NAMES if names is None else names},
    }
    if not labelled:
        del features["action"]
    if states:
        features["observation.state"] = {"dtype": "float32", "shape": (width,), "names": None}
    dataset = LeRobotDataset.create("me/arm", fps=10, features=features, root=root, robot_type=robot, use_videos=False)
    for number, episode in enumerate(actions):
        for a in episode:
            frame = np.full((size, size, 3), 40, np.uint8)
            x, y = (int(size / 2 + np.clip(v, -200, 200) / 200 * size / 3) for v in np.asarray(a[:2], float))
            frame[y - 5 : y + 5, x - 5 : x + 5] = (220, 60, 30)
            own = {"action": a} if labelled else {}
            own |= {"observation.state": a.astype(np.float32)} if states else {}
            dataset.add_frame({CAMERA: frame, "task": tasks[number * len(tasks) // len(actions)]} | own)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def edit_stats(root: Path, **changed: Any) -> None:
    """Change the statistics of the actions; None removes one."""
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    for name, value in changed.items():
        stats["action"][name] = value
        if value is None:
            del stats["action"][name]
    path.write_text(json.dumps(stats))


def meta_of(run: Path, stage: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((run / stage / "checkpoint" / "meta.json").read_text())
    return values


def ends(meta: dict[str, Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The range of a stage's actions, (A,) and (A,)."""
    return np.float32(meta["actions"]["low"]), np.float32(meta["actions"]["high"])
