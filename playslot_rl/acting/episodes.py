"""Fixed lists of episodes, several in lock-step: one network call a step for all of them.

Shapes: E episodes in lock-step, n of them still running, T agent steps, A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig

Frames = npt.NDArray[np.uint8]
Actions = npt.NDArray[np.float32]
FrameCallback = Callable[[int, int, Frames], None]

LOCKSTEP = 5
"""Episodes run side by side. Making an environment takes most of a second, and a small CPU gains little from more."""
MAX_REDRAWS = 20


class Task(Protocol):
    """What the evaluation needs of an environment."""

    draw_steps: bool

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Start the episode of `seed`; `info["success"]` says whether it starts solved."""

    def step(self, action: Actions) -> tuple[dict[str, npt.NDArray[Any]], Any, bool, bool, dict[str, Any]]:
        """One agent step; `info["success"]` says whether the task was solved in it."""

    def expert_action(self) -> Actions:
        """The scripted expert's action for the present state."""

    def close(self) -> None:
        """Free the renderer."""


class Moment(NamedTuple):
    """What a controller may look at.

    Attributes:
        step: agent steps taken so far.
        running: indices of the episodes that still run, of the E of this lock-step.
        seeds: their seeds.
        frames: their present frames (n, H, W, 3) uint8 [0, 255].
        tasks: their environments; only the scripted expert looks at them.
    """

    step: int
    running: Sequence[int]
    seeds: Sequence[int]
    frames: Frames
    tasks: Sequence[Task]


class Controller(Protocol):
    """Chooses the actions of episodes that run in lock-step.

    Attributes:
        sees_frames: it looks at the frames after the first; if not, they are not drawn.
    """

    sees_frames: bool

    def begin(self, moment: Moment) -> None:
        """New episodes, all running at step 0."""

    def act(self, moment: Moment) -> Actions:
        """Actions (n, A) in [-1, 1] of the running episodes."""


@dataclass(frozen=True)
class Episode:
    """Outcome of one episode.

    Attributes:
        seed: the seed it ran with.
        success: whether the task was solved within the step limit.
        steps: agent steps to the first success, from 1; None without one.
        redrawn: seeds passed over because the episode started solved.
    """

    seed: int
    success: bool
    steps: int | None
    redrawn: int


class TaskPool:
    """Environments made when first needed, reused between runs, and closed together."""

    def __init__(self, env: EnvConfig, render: RenderConfig) -> None:
        self.env, self.render = env, render
        self._tasks: list[Task] = []

    def take(self, count: int) -> list[Task]:
        """The first `count` environments."""
        while len(self._tasks) < count:
            from playslot_rl.envs import make_env

            task: Any = make_env(self.env, self.render).unwrapped
            self._tasks.append(task)
        return self._tasks[:count]

    def close(self) -> None:
        """Free all renderers."""
        while self._tasks:
            self._tasks.pop().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def start_episode(task: Task, seed: int, stride: int) -> tuple[Frames, int, int]:
    """Reset to an episode that does not start solved.

    Args:
        task: the environment.
        seed: the episode's seed.
        stride: distance to the seed tried next; with the number of episodes, redrawn seeds meet no other episode's,
            and every controller redraws the same ones.

    Returns:
        First frame (H, W, 3), the seed that was used, and how many were passed over.

    Raises:
        RuntimeError: MAX_REDRAWS episodes in a row start solved.
    """
    for redrawn in range(MAX_REDRAWS):
        observation, info = task.reset(seed=seed + redrawn * stride)
        if not info.get("success", False):
            return observation["pixels"], seed + redrawn * stride, redrawn
    raise RuntimeError(f"evaluation: {MAX_REDRAWS} episodes from seed {seed} on start solved; is the task trivial?")


def run_episodes(
    pool: TaskPool,
    controller: Controller,
    seeds: Sequence[int],
    on_frame: FrameCallback | None = None,
    stop: bool = True,
) -> list[Episode]:
    """Run one episode for each seed, in the order of the list.

    Args:
        pool: environments.
        controller: chooses the actions.
        seeds: the fixed list.
        on_frame: called with (episode index, step, frame); step 0 is the first observation.
        stop: end an episode at its first success (its outcome is known); False runs all `max_steps`.
    """
    episodes: list[Episode] = []
    for first in range(0, len(seeds), LOCKSTEP):
        chunk = seeds[first : first + LOCKSTEP]
        episodes += _run_chunk(pool, controller, chunk, len(seeds), first, on_frame, stop)
    return episodes


def _run_chunk(
    pool: TaskPool,
    controller: Controller,
    seeds: Sequence[int],
    stride: int,
    first: int,
    on_frame: FrameCallback | None,
    stop: bool,
) -> list[Episode]:
    tasks = pool.take(len(seeds))
    for task in tasks:
        task.draw_steps = controller.sees_frames or on_frame is not None
    started = [start_episode(task, seed, stride) for task, seed in zip(tasks, seeds, strict=True)]
    frames = [frame for frame, _, _ in started]
    solved: list[int | None] = [None] * len(seeds)
    for i, frame in enumerate(frames):
        _show(on_frame, first + i, 0, frame)
    for step in range(pool.env.max_steps):
        running = [i for i, s in enumerate(solved) if s is None or not stop]
        if not running:
            break
        used = [started[i][1] for i in running]
        now = Moment(step, running, used, np.stack([frames[i] for i in running]), [tasks[i] for i in running])
        if step == 0:
            controller.begin(now)
        for i, action in zip(running, controller.act(now), strict=True):
            observation, _, _, _, info = tasks[i].step(action)
            frames[i] = observation["pixels"]
            if info["success"] and solved[i] is None:
                solved[i] = step + 1
            _show(on_frame, first + i, step + 1, frames[i])
    return [
        Episode(seed, steps is not None, steps, redrawn)
        for (_, seed, redrawn), steps in zip(started, solved, strict=True)
    ]


def _show(on_frame: FrameCallback | None, episode: int, step: int, frame: Frames) -> None:
    if on_frame is not None:
        on_frame(episode, step, frame)
