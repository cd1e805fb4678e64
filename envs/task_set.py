"""Several of Meta-World's tasks as one environment, MT10: each episode is of one of them, which its seed says."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs.metaworld import MetaWorldEnv
from playslot_rl.envs.pixel_task import Action, Frame, Observation, PixelTask


class TaskSet(MetaWorldEnv):
    """The tasks `EnvConfig.tasks`, in turn by the episodes' seeds (`EnvConfig.of_episode`). Each is made when its first
    episode comes; all have the longest one's `max_steps`.
    """

    def __init__(
        self, env: EnvConfig, render: RenderConfig | None = None, render_mode: str | None = "rgb_array"
    ) -> None:
        PixelTask.__init__(self, env, render_mode)
        self.metadata = self.metadata_of(env)
        self._rendering, self._made = render, dict[str, MetaWorldEnv]()
        self._now = self._task_of(0)

    def _task_of(self, seed: int) -> MetaWorldEnv:
        config = self.config.of_episode(seed)
        if config.task not in self._made:
            self._made[config.task] = MetaWorldEnv(config, self._rendering, self.render_mode)
        return self._made[config.task]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        gym.Env.reset(self, seed=seed)
        self.episode = int(self.np_random.integers(2**31)) if seed is None else seed
        self._now = self._task_of(self.episode)
        self._now.draw_resets = self.draw_resets
        return self._now.reset(seed=self.episode, options=options)

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        self._now.draw_steps = self.draw_steps
        return self._now.step(action)

    def open_renderer(self) -> None:
        self._now.open_renderer()

    def draw(self) -> Frame:
        return self._now.draw()

    def segment(self) -> npt.NDArray[np.int64]:
        return self._now.segment()

    def render(self) -> Frame | None:
        return self._now.render()

    def expert_action(self) -> Action:
        return self._now.expert_action()

    def objects(self) -> tuple[tuple[str, ...], ...]:
        return self._now.objects()

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        return self._now.places()

    def close(self) -> None:
        for task in self._made.values():
            task.close()
