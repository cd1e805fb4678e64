"""A simulator of a moving dot, and a data set of it in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.source import EpisodeFrames

SIDE = 64
EPISODES, FRAMES = 3, 7


class DotTask:
    """A dot that an action moves: a task of four numbers, as quick as can be."""

    draw_steps = True
    open_tasks: int = 0

    def __init__(self) -> None:
        self.place = np.zeros(2)
        self.steps = 0
        DotTask.open_tasks += 1

    def _see(self) -> dict[str, npt.NDArray[Any]]:
        frame = np.full((SIDE, SIDE, 3), 40, np.uint8)
        x, y = (np.clip(self.place, 0, 1) * (SIDE - 8)).astype(int)
        frame[y : y + 8, x : x + 8] = (250, 60, 20)
        return {"pixels": frame, "state": self.place.astype(np.float32)}

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        self.place, self.steps = np.random.default_rng(seed).uniform(0.2, 0.8, 2), 0
        return self._see(), {"success": False}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = self.place + 0.1 * np.asarray(action[:2], np.float64)
        self.steps += 1
        return self._see(), 0.0, False, False, {"success": False}

    def expert_action(self) -> npt.NDArray[np.float32]:
        return np.zeros(4, np.float32)

    def close(self) -> None:
        DotTask.open_tasks -= 1


def make_source(frames: int = FRAMES) -> EpisodeFrames:
    """Episodes of random actions, with their seeds."""
    task, rng = DotTask(), np.random.default_rng(0)
    shown, actions = [], []
    for seed in range(EPISODES):
        shown.append(task.reset(seed=seed)[0]["pixels"])
        for _ in range(frames - 1):
            actions.append(rng.uniform(-1, 1, 4).astype(np.float32))
            shown.append(task.step(actions[-1])[0]["pixels"])
        actions.append(np.zeros(4, np.float32))
    task.close()
    return EpisodeFrames(
        frames=np.stack(shown),
        starts=np.arange(EPISODES) * frames,
        lengths=np.full(EPISODES, frames),
        actions=np.stack(actions),
        seeds=np.arange(EPISODES),
        fingerprint="0" * 16,
        fps=10.0,
        task="move the dot",
        camera="front",
    )
