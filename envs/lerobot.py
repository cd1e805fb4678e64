"""A task as LeRobot's programs expect an environment: names, `is_success`, episode length, an end at success."""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs import make_env, task_config, task_metadata

CAMERA: Final = "front"
"""Camera of the frames: LeRobot calls them `observation.images.front`, as our data sets do."""

Observation = dict[str, Any]


class LeRobotTask(gym.Wrapper[Observation, npt.NDArray[np.float32], Any, npt.NDArray[np.float32]]):
    """One of our tasks behind LeRobot's conventions (lerobot 0.6.1, `lerobot.envs` and `lerobot_eval.rollout`).

    Observations are `pixels`, `{"front": uint8 [0, 255] (H, W, 3)}`, and `agent_pos`, float32 (S,); actions float32
    (A,) in [-1, 1]. `info["is_success"]` says whether the agent step solved the task, and then the episode ends, as
    LeRobot's own environments do. (Ours go on: clips of a data set have a fixed length, `max_steps` agent steps.)
    `task_description` is what is to be done, of several tasks in the present episode. `metadata` has `render_fps`,
    agent steps a second (`control_hz / frame_skip`).
    """

    def __init__(self, env: EnvConfig | str | None = None, render: RenderConfig | None = None) -> None:
        self._config = task_config(env)
        super().__init__(make_env(self._config, render).unwrapped)
        described = task_metadata(self._config)
        self.task, self.task_description = self._config.full_name, str(described["task"])
        self._max_episode_steps = self._config.max_steps
        self.metadata = {**described, "render_fps": frames_a_second(self._config)}
        inner: Any = self.env.observation_space
        self.observation_space = gym.spaces.Dict(
            {"pixels": gym.spaces.Dict({CAMERA: inner["pixels"]}), "agent_pos": inner[keys.STATE]}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of `seed`; see the task's own `reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._config.tasks:
            episode = self._config.of_episode(self.env.get_wrapper_attr("episode"))
            self.task_description = str(task_metadata(episode)["task"])
        return _named(observation), {"is_success": bool(info["success"])}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One agent step; the reward is the task's own."""
        observation, reward, _, truncated, info = self.env.step(action)
        success = bool(info["success"])
        return _named(observation), float(reward), success, truncated, {"is_success": success}


def _named(observation: Any) -> Observation:
    return {"pixels": {CAMERA: observation["pixels"]}, "agent_pos": observation[keys.STATE]}


def frames_a_second(env: EnvConfig) -> int:
    """Agent steps a second of a task, at least 1: the rate of its videos and of its data sets."""
    hertz: int = task_metadata(env)["control_hz"]
    return max(1, round(hertz / env.frame_skip))
