"""Any registered Gymnasium environment that has pictures and a bounded Box of actions: `env=gym env.id=FetchReach-v4`.

Shapes: A = numbers of the Box, S = numbers of the environment's own observation, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import difflib
import functools
import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

import farama_notifications
import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.plain import nearest
from playslot_rl.envs.pixel_task import Action, Frame, PixelTask
from playslot_rl.envs.rendering import Camera, FrameRenderer, box_sized, import_mujoco
from playslot_rl.errors import ConfigError, first_line

Expert = Callable[[Any, dict[str, Any], np.random.Generator], npt.ArrayLike]
"""`env.expert`: of the environment's own observation and info, and a generator that is a function of the episode's
seed and of the step, the action in the environment's own units, (A,)."""

SUCCESS: Final = ("is_success", "success")
"""Entries of info that say whether a step solved the task."""
EXPERT_STREAM: Final = 4
ROUNDING: Final = 1e-5
"""By how much an expert's action may lie outside of [-1, 1]."""
NUMBERS: Final = "distance,azimuth,elevation,x,y,z"


NO_EXPERT: Final = (
    "env.expert: got nothing with env.id={}, expected package.module:function "
    "(observation, info, generator -> action), or policy=random"
)


@dataclass(frozen=True)
class Facts:
    """What an environment says of itself: widths of action and observation, the entry of info that says success (empty
    where there is none), environment steps a second, and whether MuJoCo knows its parts.
    """

    actions: int
    state: int
    success: str
    hz: float
    parts: bool


@contextmanager
def _quiet() -> Iterator[None]:
    """Warnings of old versions and missing bounds, and what is printed at an import, are about others' code."""
    farama_notifications.notifications.pop("gymnasium_robotics", None)
    before, gym.logger.min_level = gym.logger.min_level, gym.logger.ERROR
    try:
        yield
    finally:
        gym.logger.min_level = before


def _open(name: str) -> gym.Env[Any, Any]:
    """The environment of a Gymnasium id, without a limit of steps; a ConfigError where it is none that we can use."""
    import_mujoco()
    if not name:
        raise ConfigError("env.id: got nothing with env=gym, expected a Gymnasium id, such as env.id=FetchReach-v4")
    with _quiet():
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        try:
            env: gym.Env[Any, Any] = gym.make(
                name, max_episode_steps=-1, render_mode="rgb_array", disable_env_checker=True
            )
        except gym.error.UnregisteredEnv as error:
            near = ", ".join(difflib.get_close_matches(name, [*gym.registry], n=3, cutoff=0.0))
            raise ConfigError(f"env.id: got {name!r}, expected a registered id; the nearest are {near}") from error
        except Exception as error:  # whatever a foreign environment does when it is made
            raise ConfigError(
                f"env.id={name}: got {type(error).__name__} ({first_line(error)}), expected an environment that can be "
                "made: install what it needs, or choose another"
            ) from error
    space, modes, said = env.action_space, env.metadata.get("render_modes") or (), ""
    if not isinstance(space, gym.spaces.Box) or space.dtype.kind != "f":
        said = f"got actions {space}, expected a Box of real numbers"
    elif not space.is_bounded("both"):
        said = f"got actions {space}, expected bounds below and above"
    elif "rgb_array" not in modes:
        said = f"got render_modes {list(modes)}, expected rgb_array among them"
    if said:
        env.close()
        raise ConfigError(f"env.id={name}: {said}; choose another environment, or wrap it under an id of your own")
    return env


def flat(observation: Any) -> npt.NDArray[np.float32]:
    """An observation's numbers in one row, float32 (S,), pictures left out; one zero where there are none."""
    rows = [np.ravel(part) for part in _parts(observation) if part.ndim < 2]
    return np.concatenate(rows).astype(np.float32) if rows else np.zeros(1, np.float32)


def _parts(observation: Any) -> Iterator[npt.NDArray[Any]]:
    if isinstance(observation, dict):
        for part in observation.values():
            yield from _parts(part)
    else:
        yield np.asarray(observation)


@functools.cache
def facts(name: str) -> Facts:
    """Found by one step of an episode: what an environment's info holds is declared nowhere."""
    env = _open(name)
    try:
        observation, _ = env.reset(seed=0)
        box: Any = env.action_space
        info = env.step(((box.low + box.high) / 2).astype(box.dtype))[4]
        parts = _is_mujoco(env)
        if not parts:
            _picture(env, name)
    finally:
        env.close()
    success, hz = next((key for key in SUCCESS if key in info), ""), float(env.metadata.get("render_fps") or 10)
    return Facts(int(np.prod(box.shape)), len(flat(observation)), success, hz, parts)


def _is_mujoco(env: gym.Env[Any, Any]) -> bool:
    return isinstance(getattr(env.unwrapped, "model", None), import_mujoco().MjModel)


def _picture(env: gym.Env[Any, Any], name: str) -> Frame:
    """What an environment draws; a ConfigError where that is no picture."""
    picture: Any = env.render()
    if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.dtype != np.uint8:
        got = f"{picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
        raise ConfigError(f"env.id={name}: got {got} from render(), expected a picture, uint8 (H, W, 3)")
    return picture


def fitted(env: EnvConfig) -> EnvConfig:
    """`env` with the width of its environment's actions; a ConfigError where environment or expert are none."""
    if env.expert:
        load_expert(env.expert)
    return replace(env, action_dim=facts(env.id).actions)


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


def require_success(env: EnvConfig) -> None:
    """A ConfigError where an environment's info says nothing of success."""
    if not facts(env.id).success:
        raise ConfigError(
            f"env.id={env.id}: got an environment whose info says no success, expected {' or '.join(SUCCESS)} in it: "
            "`evaluate` and `compare` measure its return"
        )


def _view(env: gym.Env[Any, Any], model: Any, camera: str) -> tuple[Any, bool]:
    """What a `FrameRenderer` looks through, and whether it is at rest: a camera of the model by its name, a free one by
    its numbers, or with no words the one that the environment itself draws with.
    """
    mj = import_mujoco()
    names = [model.camera(i).name for i in range(model.ncam)]
    if not camera:
        holders = (env, *vars(env).values())
        own = next((h.mujoco_renderer for h in holders if hasattr(h, "mujoco_renderer")), None)
        number = getattr(own, "camera_id", -1)
        if number is not None and number >= 0:
            camera = names[number]
        else:
            return _free(mj, model, env, getattr(own, "default_cam_config", None) or {}), True
    if camera in names:
        at_rest = model.cam_mode[names.index(camera)] == mj.mjtCamLight.mjCAMLIGHT_FIXED
        return camera, bool(at_rest and model.cam_bodyid[names.index(camera)] == 0)
    try:
        distance, azimuth, elevation, x, y, z = (float(part) for part in camera.split(","))
    except ValueError:
        hint = nearest(camera, names, "env.camera=")
        raise ConfigError(
            f"env.camera: got {camera!r}, expected {NUMBERS} or one of {', '.join(names) or 'no names'}{hint}"
        ) from None
    return Camera(distance, azimuth, elevation, (x, y, z)), True


def _free(mj: Any, model: Any, env: Any, settings: dict[str, Any]) -> Any:
    """Gymnasium's free camera: it looks at the middle of the geoms from as far as the scene is wide, or as it says."""
    view = mj.MjvCamera()
    view.lookat[:] = np.median(env.data.geom_xpos, axis=0)
    view.distance = model.stat.extent
    for name, value in settings.items():
        if isinstance(value, np.ndarray):
            getattr(view, name)[:] = value
        else:
            setattr(view, name, value)
    view.type, view.fixedcamid = mj.mjtCamera.mjCAMERA_FREE, -1
    return view


class GymTask(PixelTask):
    """The environment of `env.id`; see `PixelTask`.

    Actions in [-1, 1] are stretched over its Box. `state_vector` is its own observation without pictures. MuJoCo's are
    drawn by `FrameRenderer`; others draw themselves, and their frames are area-averaged. One that ends early rests
    where it ended, without reward. `info["success"]` is what its own info says; where that says nothing (`solves`
    False) it is false, and evaluations measure the return. Its `reset(seed=)` gets the episode's seed.
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
        self.metadata, self.solves, self._success = self.metadata_of(config), bool(known.success), known.success
        self.has_expert = bool(config.expert)
        self._expert = load_expert(config.expert) if config.expert else None
        self.inner = _open(config.id)
        core: Any = self.inner.unwrapped
        self._simulation = SimpleNamespace(
            model=getattr(core, "model", None), data=getattr(core, "data", None), close=self.inner.close
        )
        self._mujoco = known.parts
        if self._mujoco:
            self.inner.reset(seed=0)  # a camera over the middle of the scene is over what the first episode shows
            view, at_rest = _view(core, self._simulation.model, config.camera)
            self.distance_seen = float(getattr(view, "distance", self._simulation.model.stat.extent / 2))
            self._make_renderer = partial(
                FrameRenderer, self._simulation.model, view, config.image_size, render or RenderConfig(),
                at_rest=at_rest,
            )  # fmt: skip
        elif config.camera:
            raise ConfigError(f"env.camera: got {config.camera!r}, expected none: {config.id} draws itself")
        self._observation: Any = None
        self._info: dict[str, Any] = {}
        self._over = False
        self._moment = 0

    def open_renderer(self) -> None:
        if self._mujoco:
            super().open_renderer()

    def draw(self) -> Frame:
        if self._mujoco:
            return super().draw()
        return box_sized(_picture(self.inner, self.config.id), self.config.image_size)

    def _placed(self) -> None:
        """What an environment moves only to draw it, such as a goal's mark, moves in every step: it may touch the
        simulation, which must not depend on whether it is looked at."""
        callback = getattr(self.inner.unwrapped, "_render_callback", None)
        if self._mujoco and callback is not None:
            callback()

    def _begin(self, rng: np.random.Generator) -> None:
        del rng
        self._observation, self._info = self.inner.reset(seed=self.episode)
        self._over, self._moment = False, 0
        self._placed()

    def _advance(self, action: Action) -> tuple[float, bool]:
        if self._over:
            return 0.0, False
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
        scaled = 2 * (given.reshape(box.shape) - box.low) / (box.high.astype(np.float64) - box.low) - 1
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
