"""The simulator beside the imagined scene: it does what was decoded, and shows what is true.

Shapes: A action width, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from playslot_rl.acting.episodes import Task, start_episode
from playslot_rl.play.timeline import Frame

Action = npt.NDArray[np.float32]


class Twin:
    """A simulated episode that can be brought to any sequence of actions.

    Simulators have no state that can be kept and put back in all of them, but an episode is a function of its seed and
    its actions: where the wanted actions do not go on from those that were executed, it is run again from its start.

    Args:
        task: the twin's alone.
        lead: actions (A,) that lead from the episode's first frame to where playing starts.
        stride: distance to the seed tried next where the episode starts solved; 0 never tries another.
    """

    def __init__(self, task: Task, seed: int, lead: Sequence[Action] = (), stride: int = 0) -> None:
        self._task, self._lead = task, [np.asarray(action, np.float32) for action in lead]
        self._frame, self.seed, _ = start_episode(task, seed, stride) if stride else (self._reset(seed), seed, 0)
        self._done: list[bytes] = []
        self.first = self.follow([])

    def _reset(self, seed: int) -> Frame:
        observation, _ = self._task.reset(seed=seed)
        frame: Frame = observation["pixels"]
        return frame

    def follow(self, actions: Sequence[Action]) -> Frame:
        """Bring the simulator to where these actions (A,), clipped to [-1, 1], lead from the start.

        Returns:
            What is seen there, uint8 (H, W, 3), the caller's own.
        """
        wanted = [*self._lead, *(np.clip(np.asarray(action, np.float32), -1, 1) for action in actions)]
        known = [action.tobytes() for action in wanted]
        if known[: len(self._done)] != self._done:
            self._frame, self._done = self._reset(self.seed), []
        for number in range(len(self._done), len(wanted)):
            self._task.draw_steps = number == len(wanted) - 1  # drawing is most of a step
            observation, *_ = self._task.step(wanted[number])
            self._frame = observation["pixels"]
            self._done.append(known[number])
        return self._frame.copy()

    def close(self) -> None:
        """Free the renderer."""
        self._task.close()
