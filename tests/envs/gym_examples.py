"""Gymnasium environments of a user, and experts for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np

from playslot_rl.envs.rendering import import_mujoco

GOAL = 3.0


class Line(gym.Env[Any, Any]):
    """A dot on a line draws itself, 20 x 40 pixels; actions from -2 to 4. Seeds have 32 bits, as of old. Its info says
    nothing of success, or in the last step alone, by the name that `says` gives.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    observation_space = gym.spaces.Box(-10, 10, (1,), np.float64)

    def __init__(
        self,
        render_mode: str | None = None,
        space: Any = None,
        modes: Any = None,
        picture: Any = None,
        says: str = "",
        fails: str = "",
        lost: str = "",
    ) -> None:
        self.render_mode, self.picture, self.taken = render_mode, picture, np.zeros(0)
        self.says, self.fails, self.lost = says, fails, lost
        self.action_space = gym.spaces.Box(-2.0, 4.0, (1,), np.float32) if space is None else space
        self.metadata = {**self.metadata, **({} if modes is None else {"render_modes": modes})}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._fail("reset")
        self.place = float(np.random.RandomState(seed).uniform(-1, 1))
        return np.array([self.place]), {}

    def step(self, action: Any) -> Any:
        self._fail("step")
        self.taken = np.asarray(action)
        self.place += 0.1 * float(self.taken[0])
        over = self.place > GOAL
        values = {"place": self.place, "reward": 1.0} | ({self.lost: np.nan} if self.lost else {})
        info = {self.says: True} if self.says and over else {}
        return np.array([values["place"]]), values["reward"], over, False, info

    def _fail(self, where: str) -> None:
        if self.fails == where:
            raise RuntimeError("no licence\nask for one")

    def render(self) -> Any:
        self._fail("render")
        if self.picture is not None:
            return self.picture
        frame = np.zeros((20, 40, 3), np.uint8)
        frame[:, : int(20 + 5 * np.clip(self.place, -4, 4))] = 200
        return frame


class Ball(gym.Env[Any, Any]):
    """A ball on a plane of MuJoCo, whose model or data (`anew`) are made anew in each reset, seen freely or through a
    camera that has no name. In a model of its own the ball is the redder the farther right it is.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Box(-9, 9, (1,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, render_mode: str | None = None, anew: str = "", camera: int = -1) -> None:
        self.render_mode, self.anew, self.mujoco_renderer = render_mode, anew, SimpleNamespace(camera_id=camera)
        self._make(0.0)

    def _make(self, place: float) -> None:
        mj = import_mujoco()
        colour = f"{0.5 + place / 1.2} 0 {0.5 - place / 1.2} 1"
        self.model = mj.MjModel.from_xml_string(
            f"""<mujoco><worldbody><light pos='0 0 3'/><geom type='plane' size='1 1 .1' rgba='.4 .4 .4 1'/>
            <camera pos='0 -2 1.5' euler='55 0 0'/><body name='ball' pos='{place} 0 .3'>
            <joint type='slide' axis='1 0 0'/><geom size='.2' rgba='{colour}'/></body></worldbody></mujoco>"""
        )
        self.data = mj.MjData(self.model)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        place, mj = float(self.np_random.uniform(-0.6, 0.6)), import_mujoco()
        if self.anew == "model":
            self._make(place)
        else:
            self.data = mj.MjData(self.model)
            self.data.qpos[0] = place
        mj.mj_forward(self.model, self.data)
        return self.data.body("ball").xpos[:1].copy(), {}

    def step(self, action: Any) -> Any:
        import_mujoco().mj_step(self.model, self.data)
        return self.data.body("ball").xpos[:1].copy(), 0.0, False, False, {}


def register(name: str, made: type[gym.Env[Any, Any]] = Line, limit: int | None = None, **kwargs: Any) -> str:
    """An environment under an id of its own, with a limit of steps."""
    if name not in gym.registry:
        gym.register(name, entry_point=made, max_episode_steps=limit, kwargs=kwargs)
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


def of_two(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    """For a Box whose second number is always 1."""
    return np.array([1.0, 1.0])


def in_words(observation: Any, info: dict[str, Any], generator: np.random.Generator) -> Any:
    return "right"


NOTHING = 3
