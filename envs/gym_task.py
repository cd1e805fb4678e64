"""Any registered Gymnasium environment that has pictures and a bounded Box of actions: `env=gym env.id=FetchReach-v4`.

Shapes: A = numbers of the Box, S = numbers of the environment's own observation, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs.gym_facts import SUCCESS, facts, first_steps, flat, open_env, picture
from playslot_rl.envs.gym_scene import Scene, distance_seen, view
from playslot_rl.envs.pixel_task import Action, Frame, PixelTask
from playslot_rl.envs.rendering import FrameRenderer, box_sized
from playslot_rl.errors import ConfigError, first_line

Expert = Callable[[Any, dict[str, Any], np.random.Generator], npt.ArrayLike]
"""`env.expert`: of the environment's own observation and info, and a generator that is a function of the episode's
seed and of the step, the action in the environment's own units, (A,)."""

EXPERT_STREAM: Final = 4
ROUNDING: Final = 1e-5
"""By how much an expert's action may lie outside of [-1, 1]."""
SEED_BITS: Final = 32
"""Of the seeds that any environment takes: numpy's older generator refuses longer ones."""
NO_EXPERT: Final = (
    "env.expert: got nothing with env.id={}, expected package.module:function "
    "(observation, info, generator -> action); `collect` records without one (policy=random)"
)


def fitted(env: EnvConfig) -> dict[str, int]:
    """What the environment itself says of `EnvConfig`: the width of its actions and, where it has one, its limit of
    steps; a ConfigError where environment or expert are none.
    """
    if env.expert:
        load_expert(env.expert)
    known = facts(env.id)
    steps = {"max_steps": max(2, -(-known.steps // env.frame_skip))} if known.steps else {}
    return {"action_dim": known.actions, **steps}


def short_seed(number: int) -> int:
    """An episode's number as any environment takes it: itself below 2^32, else 32 bits mixed from all of its own.

    Note: not the remainder, by which a test's episodes would be those of a collection.
    """
    return number if number < 2**SEED_BITS else int(np.random.SeedSequence(number).generate_state(1)[0])


def load_expert(name: str) -> Expert:
    """The function of `env.expert`, `package.module:function`; a ConfigError where it is none."""
    module, _, attribute = name.partition(":")
    said = ""
    try:
        found: Any = getattr(importlib.import_module(module), attribute) if name else None
        said = "" if callable(found) else f"got {name!r}, no function"
    except Exception as error:  # noqa: BLE001  whatever a foreign module does when it is imported
        said = f"got {name!r} ({type(error).__name__}: {first_line(error)})"
    if said:
        raise ConfigError(
            f"env.expert: {said}, expected package.module:function that can be imported: install it, or put its folder "
            "into PYTHONPATH"
        )
    return found  # type: ignore[no-any-return]


def require_expert(env: EnvConfig) -> Expert:
    """The expert that the user names; a ConfigError without one."""
    if not env.expert:
        raise ConfigError(NO_EXPERT.format(env.id))
    return load_expert(env.expert)


def check_expert(env: EnvConfig) -> None:
    """A ConfigError without an expert, or where its first action is none of the environment's."""
    require_expert(env)
    task = GymTask(env)
    try:
        task._begin(np.random.default_rng(0))
        task.expert_action()
    finally:
        task.inner.close()


@cache
def warn_of_success(name: str, success: str) -> None:
    """Warn, once, where no step of a trial had `env.success` in its info: an entry that comes late, or is misspelt."""
    entries = facts(name).entries
    if success and success not in entries:
        warnings.warn(
            f"env.success={success}: got no such entry in the info of a trial of {name}, expected one of "
            f"{', '.join(entries) or 'those that it has'}, or one that comes later: nothing is a success where it "
            "is missing",
            RuntimeWarning,
            stacklevel=3,
        )


def require_success(env: EnvConfig) -> None:
    """A ConfigError where an environment's info says nothing of success."""
    if not (env.success or facts(env.id).success):
        raise ConfigError(
            f"env.id={env.id}: got an environment whose info says no success, expected {' or '.join(SUCCESS)} in it: "
            "name another entry (env.success=), or `evaluate` and `compare` measure its return"
        )


class GymTask(PixelTask):
    """The environment of `env.id`; see `PixelTask`.

    Actions in [-1, 1] are stretched over its Box. `state_vector` is its own observation without pictures. MuJoCo's are
    drawn by `FrameRenderer`; others draw themselves, and their frames are area-averaged. One that ends early rests
    where it ended, without reward. `info["success"]` is what its own info says; where that says nothing (`solves`
    False) it is false, and evaluations measure the return. Its `reset(seed=)` gets the episode's `short_seed`.
    """

    scenery = False
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as Gymnasium has it)

    @classmethod
    def metadata_of(cls, config: EnvConfig) -> dict[str, Any]:
        """Gymnasium's metadata of the task that `env.id` names."""
        said = {"control_hz": facts(config.id).hz, "task": f"Solve {config.id}."}
        return {**cls.metadata, **said, "action": f"the numbers of {config.id}'s Box, scaled to [-1, 1]"}

    @classmethod
    def actions_of(cls, config: EnvConfig) -> int:
        return facts(config.id).actions

    @classmethod
    def in_mujoco(cls, config: EnvConfig) -> bool:
        """Whether `env.id` has a MuJoCo model."""
        return facts(config.id).parts

    def __init__(
        self, env: EnvConfig | None = None, render: RenderConfig | None = None, render_mode: str | None = "rgb_array"
    ) -> None:
        config = env or EnvConfig("gym")
        known = facts(config.id)
        super().__init__(config, render_mode, actions=known.actions, state=known.state)
        self.metadata, self._success = self.metadata_of(config), config.success or known.success
        self.solves, self.has_expert = bool(self._success), bool(config.expert)
        self._expert = load_expert(config.expert) if config.expert else None
        self.inner = open_env(config.id)
        self._simulation = Scene(self.inner)
        self._mujoco, self._render, self._view = known.parts, render or RenderConfig(), None
        if self._mujoco:
            with first_steps(config.id):
                self.inner.reset(seed=0)  # a camera over the middle of the scene is over what the first episode shows
            self._aim()
        elif config.camera:
            raise ConfigError(f"env.camera: got {config.camera!r}, expected none: {config.id} draws itself")
        self._observation: Any = None
        self._info: dict[str, Any] = {}
        self._over = False
        self._moment = 0

    def _aim(self) -> None:
        """Have what draws look at the present model, a free camera always from the same place."""
        self._drawn = self._simulation.model
        found, at_rest = view(self._simulation.core, self._drawn, self.config.camera)
        self._view = found if self._view is None else self._view
        self.distance_seen = distance_seen(self._drawn, self._view)
        self._make_renderer = partial(
            FrameRenderer, self._drawn, self._view, self.config.image_size, self._render, at_rest=at_rest
        )

    def _redraw(self) -> None:
        """Make what draws anew where the environment has made another model."""
        if not self._mujoco or self._simulation.model is self._drawn:
            return
        self._aim()
        if "_renderer" in self.__dict__:
            self.__dict__.pop("_renderer").close()
            self._variation = None
            self.open_renderer()
            self._vary()

    def open_renderer(self) -> None:
        if self._mujoco:
            super().open_renderer()

    def draw(self) -> Frame:
        if self._mujoco:
            return super().draw()
        return box_sized(picture(self.inner, self.config.id), self.config.image_size)

    def _placed(self) -> None:
        """What an environment moves only to draw it, such as a goal's mark, moves in every step: it may touch the
        simulation, which must not depend on whether it is looked at."""
        callback = getattr(self.inner.unwrapped, "_render_callback", None)
        if self._mujoco and callback is not None:
            callback()
        self._redraw()

    def _begin(self, rng: np.random.Generator) -> None:
        del rng
        self._observation, self._info = self.inner.reset(seed=short_seed(self.episode))
        self._over, self._moment = False, 0
        self._placed()

    def _advance(self, action: Action) -> tuple[float, bool]:
        if self._over:
            return 0.0, self._solved()
        box: Any = self.inner.action_space
        plain = (box.low == -1).all() and (box.high == 1).all()
        spread = action.reshape(box.shape) if plain else self._spread(action)
        self._observation, reward, ended, cut, self._info = self.inner.step(spread.astype(box.dtype))
        self._over, self._moment = bool(ended or cut), self._moment + 1
        self._placed()
        return float(reward), self._solved()

    def _spread(self, action: Action) -> npt.NDArray[np.float64]:
        box: Any = self.inner.action_space
        low, high = box.low.astype(np.float64), box.high.astype(np.float64)
        spread: npt.NDArray[np.float64] = np.clip(low + (action.reshape(box.shape) + 1) / 2 * (high - low), low, high)
        return spread

    def _solved(self) -> bool:
        seen, judge = self._observation, getattr(self.inner.unwrapped, "_is_success", None)
        goals = isinstance(seen, dict) and {"achieved_goal", "desired_goal"} <= seen.keys()
        if goals and judge and self.solves and self._success not in self._info:  # Fetch's reset does not say it
            return bool(judge(seen["achieved_goal"], seen["desired_goal"]))
        return bool(np.any(self._info.get(self._success, False)))

    def _state(self) -> npt.NDArray[np.float32]:
        return flat(self._observation)

    def expert_action(self) -> Action:
        """What `env.expert` does now, scaled to [-1, 1]; a ConfigError without one, or for one outside its Box."""
        expert = self._expert or require_expert(self.config)
        stream = np.random.SeedSequence(self.episode, spawn_key=(EXPERT_STREAM, self._moment))
        box: Any = self.inner.action_space
        try:
            given = np.asarray(expert(self._observation, self._info, np.random.default_rng(stream)), np.float64)
        except Exception as error:  # whatever a foreign function does
            raise ConfigError(
                f"env.expert={self.config.expert}: got {type(error).__name__} ({first_line(error)}), expected a "
                f"function (observation, info, generator) that gives {self.config.action_dim} numbers"
            ) from error
        if given.size != self.config.action_dim or not np.isfinite(given).all():
            raise ConfigError(
                f"env.expert={self.config.expert}: got {given!r}, expected {self.config.action_dim} finite numbers"
            )
        given, wide = given.reshape(box.shape), box.high > box.low
        width = np.where(wide, box.high.astype(np.float64) - box.low, 1.0)
        scaled = np.where(wide, 2 * (given - box.low) / width - 1, 2.0 * ~np.isclose(given, box.low))
        if np.abs(scaled).max() > 1 + ROUNDING:
            raise ConfigError(f"env.expert={self.config.expert}: got {given!r}, expected it in {box}: clip it there")
        clipped: Action = np.clip(scaled.ravel(), -1.0, 1.0).astype(np.float32)
        return clipped

    def objects(self) -> Sequence[Sequence[str]]:
        """Each child of MuJoCo's world with a joint in it or below."""
        model = self._simulation.model
        moving = {int(model.body_rootid[body]) for body in model.jnt_bodyid} if self._mujoco else set()
        return [(model.body(body).name,) for body in sorted(moving) if model.body(body).name]

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        """The achieved goal of a goal environment, padded with zeros; of others the bodies that have joints."""
        goal = self._observation.get("achieved_goal") if isinstance(self._observation, dict) else None
        if isinstance(goal, np.ndarray) and goal.ndim == 1:
            padded = np.pad(goal.astype(np.float64), (0, -len(goal) % 3)).reshape(-1, 3)
            return {f"goal{i}": row for i, row in enumerate(padded)}
        if not self._mujoco:
            raise ConfigError(f"env.id={self.config.id}: got an environment without places, expected a MuJoCo one")
        bodies = sorted({int(body) for body in self._simulation.model.jnt_bodyid})
        return {f"body{body}": self._simulation.data.xpos[body].copy() for body in bodies}
