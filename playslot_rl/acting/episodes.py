"""The one loop over episodes: fixed lists of them, several in lock-step, one call of the actor a step for all.

It serves evaluation (outcomes), learning by acting (rewards, and what the actor made of each frame) and pictures.

Shapes: E episodes in lock-step, n of them still running, T agent steps, A action dim, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase

from playslot_rl import keys
from playslot_rl.acting.actor import Actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.seeds.episodes import whole_turns

Frames = npt.NDArray[np.uint8]
Actions = npt.NDArray[np.float32]

LOCKSTEP = 5
"""Episodes run side by side. Making an environment takes most of a second, and a small CPU gains little from more."""
MAX_REDRAWS = 20


class Task(Protocol):
    """What the loop needs of an environment."""

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
    """Where the running episodes of a lock-step stand, for who looks on.

    Attributes:
        step: agent steps taken so far.
        episodes: their places in the list of seeds (n).
        frames: their present frames (n, H, W, 3) uint8 [0, 255].
        rewards: float32 (n,), received on the way to these frames; 0 at step 0.
        seen: what the actor wrote at these frames, batch size [n]; None after the last step (but see `see_last`).
    """

    step: int
    episodes: Sequence[int]
    frames: Frames
    rewards: npt.NDArray[np.float32]
    seen: TensorDictBase | None


LookOn = Callable[[Moment], None]


@dataclass(frozen=True)
class Outcome:
    """The seed an episode ran with, whether the task was solved within the step limit (None where a task measures no
    success: its rewards are summed in `total` instead), agent steps to the first success (from 1; None without one),
    and seeds passed over because the episode started solved.
    """

    seed: int
    success: bool | None
    steps: int | None
    redrawn: int
    total: float | None = None

    def plain(self) -> dict[str, Any]:
        """As JSON; `total` only where there is no success."""
        return {name: value for name, value in asdict(self).items() if name != "total" or value is not None}


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


def start_episode(task: Task, seed: int, stride: int) -> tuple[dict[str, npt.NDArray[Any]], int, int]:
    """Reset to an episode that does not start solved; the seed tried next is `stride` further.

    Returns:
        First observation, the seed that was used, and how many were passed over.

    Raises:
        RuntimeError: MAX_REDRAWS episodes in a row start solved.
    """
    for redrawn in range(MAX_REDRAWS):
        observation, info = task.reset(seed=seed + redrawn * stride)
        if not info.get("success", False):
            return observation, seed + redrawn * stride, redrawn
    raise RuntimeError(f"evaluation: {MAX_REDRAWS} episodes from seed {seed} on start solved; is the task trivial?")


def run_episodes(
    pool: TaskPool,
    actor: Actor,
    seeds: Sequence[int],
    look_on: LookOn | None = None,
    *,
    stop: bool = True,
    see_last: bool = False,
    draw: bool = True,
    stride: int | None = None,
    lockstep: int = LOCKSTEP,
) -> list[Outcome]:
    """Run one episode for each seed, in the order of the list; the actor begins anew with every lock-step.

    Args:
        look_on: called before every agent step, and after the last one.
        stop: end an episode at its first success (its outcome is known); False runs all `max_steps`.
        see_last: show the actor the last frame too, though it cannot act any more.
        draw: draw also the frames that the actor does not look at, where there is a `look_on`.
        stride: distance between the seeds of an episode that is drawn anew because it starts solved. None is the number
            of episodes: redrawn seeds meet no other episode's, and every actor redraws the same ones. It is rounded up
            so that the episode keeps its task or goal (`EnvConfig.turns`).
    """
    outcomes: list[Outcome] = []
    stride = whole_turns(stride or len(seeds), pool.env.turns)
    for first in range(0, len(seeds), lockstep):
        chunk = seeds[first : first + lockstep]
        episodes = _LockStep(pool, actor, chunk, first, stride, look_on, draw)
        outcomes += episodes.run(stop, see_last)
    return outcomes


def record(
    pool: TaskPool, actor: Actor, seeds: Sequence[int], look_on: LookOn | None = None
) -> tuple[Frames, list[Outcome]]:
    """Frames (E, T + 1, H, W, 3) of whole episodes, past success too, and their outcomes."""
    size = pool.env.image_size
    frames = np.zeros((len(seeds), pool.env.max_steps + 1, size, size, 3), np.uint8)

    def keep(moment: Moment) -> None:
        frames[moment.episodes, moment.step] = moment.frames
        if look_on is not None:
            look_on(moment)

    return frames, run_episodes(pool, actor, seeds, keep, stop=False)


class _LockStep:
    """Some episodes side by side."""

    def __init__(
        self,
        pool: TaskPool,
        actor: Actor,
        seeds: Sequence[int],
        first: int,
        stride: int,
        look_on: LookOn | None,
        draw: bool,
    ) -> None:
        self.tasks, self.max_steps = pool.take(len(seeds)), pool.env.max_steps
        self.actor, self.first, self.look_on = actor, first, look_on
        for task in self.tasks:
            task.draw_steps = actor.looks == "always" or (draw and look_on is not None)
        self.started = [start_episode(task, seed, stride) for task, seed in zip(self.tasks, seeds, strict=True)]
        self.observed = [observation for observation, _, _ in self.started]
        self.rewards, self.totals = np.zeros(len(seeds), np.float32), np.zeros(len(seeds))
        self.solved: list[int | None] = [None] * len(seeds)
        self.loop = ClosedLoop(actor)
        self.loop.reset([seed for _, seed, _ in self.started])

    def run(self, stop: bool, see_last: bool) -> list[Outcome]:
        """All steps; see `run_episodes`."""
        for step in range(self.max_steps + 1):
            running = [i for i, s in enumerate(self.solved) if s is None or not stop]
            if not running:
                break
            last = step == self.max_steps
            seen = None if last and not see_last else self.loop.step(self._observe(running, step), running)
            if self.look_on is not None:
                episodes = [self.first + i for i in running]
                frames = self._stack(keys.PIXELS, running)
                self.look_on(Moment(step, episodes, frames, self.rewards[running].copy(), seen))
            if seen is not None and not last:
                self._execute(running, seen, step + 1)
        found = []
        for task, (_, seed, redrawn), steps, total in zip(
            self.tasks, self.started, self.solved, self.totals.tolist(), strict=True
        ):
            solves = getattr(task, "solves", True)
            found.append(
                Outcome(seed, steps is not None if solves else None, steps, redrawn, None if solves else total)
            )
        return found

    def _observe(self, running: Sequence[int], step: int) -> TensorDict:
        """What the actor reads of the running episodes."""
        values, device = {}, self.actor.device
        if self.actor.looks == "always" or (self.actor.looks == "first" and step == 0):
            values[keys.PIXELS] = torch.from_numpy(self._stack(keys.PIXELS, running)).to(device).movedim(-1, -3)
        if keys.STATE in self.actor.in_keys:
            values[keys.STATE] = torch.from_numpy(self._stack(keys.STATE, running)).to(device)
        if keys.EXPERT_ACTION in self.actor.in_keys:
            actions = np.stack([self.tasks[i].expert_action() for i in running])
            values[keys.EXPERT_ACTION] = torch.from_numpy(actions).to(device)
        return TensorDict(values, [len(running)])

    def _stack(self, key: str, running: Sequence[int]) -> npt.NDArray[Any]:
        return np.stack([self.observed[i][key] for i in running])

    def _execute(self, running: Sequence[int], seen: TensorDictBase, step: int) -> None:
        actions = self.actor.executed(seen.get(keys.ACTION)).cpu().numpy()
        for i, action in zip(running, actions, strict=True):
            self.observed[i], reward, _, _, info = self.tasks[i].step(action)
            self.rewards[i] = reward
            self.totals[i] += float(reward)
            if info["success"] and self.solved[i] is None:
                self.solved[i] = step
