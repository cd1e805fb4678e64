"""Goal images that can be reached: frames of the scripted expert's own episodes, held-out ones, and the episodes in
which others are to reach them.

An episode is a function of its seed, so the expert's goal and whoever plans towards it share one layout.

Shapes: T agent steps from start to goal, P things with a place, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.acting.actor import ExpertActor
from playslot_rl.acting.episodes import Task, TaskPool, run_episodes
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.planning import GoalName, PlanConfig
from playslot_rl.errors import ConfigError

Frames = npt.NDArray[np.uint8]
Places = npt.NDArray[np.float64]


@dataclass
class Trace:
    """What an episode went through: T + 1 frames (H, W, 3), where one that is not drawn repeats the last one drawn, and
    T + 1 places (P, 3) in metres.
    """

    frames: list[Frames] = field(default_factory=list)
    places: list[Places] = field(default_factory=list)


class GoalTask:
    """A task whose episodes may begin after some steps of the expert, and leave a trace."""

    def __init__(self, task: Any, starts: Mapping[int, int], traces: dict[int, Trace]) -> None:
        self._task, self._starts, self._traces = task, starts, traces
        self._trace = Trace()
        self.draw_steps = True

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        assert seed is not None
        self._task.draw_steps = True
        observation, info = self._task.reset(seed=seed)
        for _ in range(self._starts.get(seed, 0)):
            observation, _, _, _, info = self._task.step(self._task.expert_action())
        self._trace = self._traces[seed] = Trace()
        self._note(observation["pixels"])
        return observation, info

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[dict[str, npt.NDArray[Any]], Any, bool, bool, dict[str, Any]]:
        self._task.draw_steps = self.draw_steps
        observation, reward, terminated, truncated, info = self._task.step(action)
        self._note(observation["pixels"])
        return observation, reward, terminated, truncated, info

    def _note(self, frame: Frames) -> None:
        self._trace.frames.append(frame)
        self._trace.places.append(np.stack(list(self._task.places().values())))

    def expert_action(self) -> npt.NDArray[np.float32]:
        action: npt.NDArray[np.float32] = self._task.expert_action()
        return action

    def close(self) -> None:
        self._task.close()


class GoalPool(TaskPool):
    """Environments whose episodes begin where the expert was after so many steps: `starts` by the episode's seed, the
    first frame where it has none. `traces` are what each episode went through, by its seed.
    """

    def __init__(self, env: EnvConfig, render: RenderConfig) -> None:
        super().__init__(env, render)
        self.starts: dict[int, int] = {}
        self.traces: dict[int, Trace] = {}
        self._wrapped: list[Task] = []

    def take(self, count: int) -> list[Task]:
        for task in super().take(count)[len(self._wrapped) :]:
            self._wrapped.append(GoalTask(task, self.starts, self.traces))
        return self._wrapped[:count]

    def begin(self, goals: Sequence[GoalEpisode], max_steps: int) -> None:
        """Have the episodes of some goals begin where these say, with so many steps to act in."""
        self.starts.clear()
        self.starts.update({goal.seed: goal.start for goal in goals})
        self.traces.clear()
        self.env = replace(self.env, max_steps=max_steps)


@dataclass(frozen=True)
class GoalEpisode:
    """Something to reach, from `start` agent steps of the expert on: frames (T + 1, H, W, 3) and places (T + 1, P, 3)
    in metres of its way from start to goal, both included.
    """

    seed: int
    start: int
    frames: Frames
    places: Places

    @property
    def image(self) -> Tensor:
        """The goal image (3, H, W) uint8 [0, 255]."""
        return torch.from_numpy(self.frames[-1]).movedim(-1, 0)


def distance(places: Places, others: Places) -> float:
    """The largest of the distances between things (P, 3) and (P, 3), in metres."""
    return float(np.linalg.norm(places - others, axis=-1).max())


def make_goals(pool: GoalPool, seeds: Sequence[int], goals: GoalName, plan: PlanConfig, seed: int) -> list[GoalEpisode]:
    """Run the expert in the episodes of some seeds, for the pool's `env.max_steps`, and take goals from what it did;
    the draw of starts has a seed of its own.

    `solved`: from the first frame to the frame in which the expert solved the task. `ahead`: `plan.ahead` environment
    steps from a start drawn at random, neither solved nor already near the goal. Episodes that give no goal are left
    out, those that start solved drawn anew; a ConfigError where no goal is left.
    """
    pool.begin([], pool.env.max_steps)
    outcomes = run_episodes(pool, ExpertActor(), seeds, lambda _: None, stop=False)
    ahead = max(1, round(plan.ahead / pool.env.frame_skip))
    found = []
    for outcome in outcomes:
        trace = pool.traces[outcome.seed]
        frames, places = np.stack(trace.frames), np.stack(trace.places)
        solved = outcome.steps
        if goals == "solved":
            ways = [] if solved is None else [(0, solved)]
        else:
            last = len(frames) - ahead if solved is None else min(len(frames) - ahead, solved)
            ways = [(s, s + ahead) for s in range(last) if distance(places[s], places[s + ahead]) >= plan.near]
        if ways:
            first, end = ways[int(np.random.default_rng([seed, outcome.seed]).integers(len(ways)))]
            found.append(GoalEpisode(outcome.seed, first, frames[first : end + 1], places[first : end + 1]))
    if not found:
        raise ConfigError(
            f"plan.goals={goals}: got no goal from the expert's {len(seeds)} episodes, expected some: more episodes=, "
            "another plan.ahead or a smaller plan.near"
        )
    return found
