"""Our simulated tasks as an environment of LeRobot: `--env.type=playslot --env.task=button_press`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

import playslot_rl.config as ours
from playslot_rl.envs import state_width, task_config
from playslot_rl.envs.lerobot import CAMERA, LeRobotTask, frames_a_second

IMAGE = f"{OBS_IMAGES}.{CAMERA}"
STATE = "agent_pos"


@EnvConfig.register_subclass("playslot")
@dataclass
class PlaySlotEnv(EnvConfig):
    """A task of playslot_rl.

    Attributes:
        task: `button_press`, `block_push`, `block_push_easy`, `block_reach`, `block_pick`, or one of Meta-World's or
            OGBench's, `metaworld/drawer-open`, or several, `metaworld/reach+push`.
        episode_length: longest episode in agent steps; None takes the task's own.
        frame_skip: environment steps of an agent step; None takes the task's own. A policy that was trained on one
            frame in three acts at a third of the rate: three times as many.
        quality: `fast` or `full`, as `render.quality` of the commands.
    """

    task: str | None = "button_press"
    episode_length: int | None = None
    frame_skip: int | None = None
    image_size: int = 64
    quality: str = "fast"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=lambda: {ACTION: ACTION, IMAGE: IMAGE, STATE: OBS_STATE})

    def __post_init__(self) -> None:
        env = self.task_config()
        self.fps = frames_a_second(env)
        side = env.image_size
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (env.action_dim,)),
            IMAGE: PolicyFeature(FeatureType.VISUAL, (side, side, 3)),
            STATE: PolicyFeature(FeatureType.STATE, (state_width(env),)),
        }

    def task_config(self) -> ours.EnvConfig:
        """The task's settings in playslot_rl, with the changes made here."""
        env = replace(task_config(str(self.task)), image_size=self.image_size)
        longest = env.max_steps if self.episode_length is None else self.episode_length
        skip = env.frame_skip if self.frame_skip is None else self.frame_skip
        return replace(env, max_steps=longest, frame_skip=skip)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `playslot_rl.envs.lerobot.LeRobotTask`."""
        render = ours.from_dict(ours.RenderConfig, {"quality": self.quality}, "render.")
        return {"env": self.task_config(), "render": render}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """`n_envs` environments side by side, in processes of their own if asked for, as {task: {0: environments}}. One
        that is done waits for the others without simulating; what it does then is not counted.
        """
        make = freeze_after_episode_end(partial(LeRobotTask, **self.gym_kwargs))
        makers = [make for _ in range(n_envs)]
        vector: gym.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            vector = AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP, context="forkserver")
        else:
            vector = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        return {str(self.task): {0: vector}}
