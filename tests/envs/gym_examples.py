"""Gymnasium environments of a user, and experts for them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

GOAL = 3.0


class Line(gym.Env[Any, Any]):
    """A dot on a line draws itself, 20 x 40 pixels; actions from -2 to 4; its info says nothing of success."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    observation_space = gym.spaces.Box(-10, 10, (1,), np.float64)

    def __init__(
        self, render_mode: str | None = None, space: Any = None, modes: Any = None, picture: Any = None
    ) -> None:
        self.render_mode, self.picture, self.taken = render_mode, picture, np.zeros(0)
        self.action_space = gym.spaces.Box(-2.0, 4.0, (1,), np.float32) if space is None else space
        self.metadata = {**self.metadata, **({} if modes is None else {"render_modes": modes})}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = float(self.np_random.uniform(-1, 1))
        return np.array([self.place]), {}

    def step(self, action: Any) -> Any:
        self.taken = np.asarray(action)
        self.place += 0.1 * float(self.taken[0])
        return np.array([self.place]), 1.0, self.place > GOAL, False, {}

    def render(self) -> Any:
        if self.picture is not None:
            return self.picture
        frame = np.zeros((20, 40, 3), np.uint8)
        frame[:, : int(20 + 5 * np.clip(self.place, -4, 4))] = 200
        return frame


def register(name: str, **kwargs: Any) -> str:
    """A `Line` under an id of its own."""
    if name not in gym.registry:
        gym.register(name, entry_point=Line, kwargs=kwargs)
    return name


def to_the_right(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return np.array([1.0 + 0.01 * generator.standard_normal()])


def reach(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    """Straight to FetchReach's goal."""
    return np.append(np.clip(10 * (observation["desired_goal"] - observation["achieved_goal"]), -1, 1), 0.0)


def too_far(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return np.array([4.1])


def too_many(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return np.zeros(7)


def of_one(observation: Any) -> Any:
    return np.zeros(1)


def forgetful(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return info["goal"]


def in_words(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return "right"


NOTHING = 3
