"""The TorchRL form of a task: a `GymWrapper` round a view with the library's keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from torchrl.envs import DTypeCastTransform, EnvBase, GymWrapper, TransformedEnv

from playslot_rl import keys

View = dict[str, npt.NDArray[Any]]


class TensorView(gym.Wrapper[View, npt.NDArray[np.float32], dict[str, npt.NDArray[Any]], npt.NDArray[np.float32]]):
    """Observations as TorchRL wants them, under the names of `keys.py`, and `more` that a subclass's `view` adds.

    `keys.PIXELS` uint8 [0, 255] (3, H, W), `keys.STATE` float32 (S,), `keys.SUCCESS` bool (1,): whether the last agent
    step solved the task (after a reset: whether the episode starts solved).
    """

    def __init__(self, env: gym.Env[Any, Any], more: Mapping[str, gym.Space[Any]] | None = None) -> None:
        super().__init__(env)
        spaces = cast(gym.spaces.Dict, env.observation_space)
        height, width, channels = spaces["pixels"].shape or ()
        shown: dict[str, gym.Space[Any]] = {
            keys.PIXELS: gym.spaces.Box(0, 255, (channels, height, width), np.uint8),
            keys.STATE: spaces[keys.STATE],
            keys.SUCCESS: gym.spaces.MultiBinary(1),
            **(more or {}),
        }
        self.observation_space = cast(gym.Space[View], gym.spaces.Dict(shown))
        self._seed: int | None = None

    def view(self, observation: dict[str, npt.NDArray[Any]], info: dict[str, Any]) -> View:
        """One observation and its info under the new names."""
        return {
            keys.PIXELS: np.ascontiguousarray(observation["pixels"].transpose(2, 0, 1)),
            keys.STATE: observation[keys.STATE],
            keys.SUCCESS: np.array([info["success"]], np.int8),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[View, dict[str, Any]]:
        """Gymnasium's reset; once after `reset(seed=s)`, a reset without a seed starts the episode of `s` again.

        TorchRL's `set_seed(s)` resets with the seed and then again without it, which would skip that episode.
        """
        if seed is None:
            seed, self._seed = self._seed, None
        else:
            self._seed = seed
        observation, info = self.env.reset(seed=seed, options=options)
        return self.view(observation, info), info

    def step(self, action: npt.NDArray[np.float32]) -> tuple[View, Any, bool, bool, dict[str, Any]]:
        self._seed = None
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.view(observation, info), reward, terminated, truncated, info


def wrap(view: gym.Env[Any, Any]) -> EnvBase:
    """A `GymWrapper` whose `keys.SUCCESS` entry is boolean."""
    boolean = DTypeCastTransform(torch.int8, torch.bool, in_keys=[keys.SUCCESS])
    return TransformedEnv(GymWrapper(view, device="cpu"), boolean)
