"""What a registered Gymnasium environment says of itself, found by trying it: `env.id`.

Shapes: A = numbers of its Box, S = numbers of its own observation.
"""

from __future__ import annotations

import difflib
import functools
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Final

import farama_notifications
import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl.envs.pixel_task import Frame
from playslot_rl.envs.rendering import import_mujoco
from playslot_rl.errors import ConfigError, PlaySlotError, first_line

SUCCESS: Final = ("is_success", "success")
"""Entries of info that say whether a step solved the task."""
PROBED: Final = 200
"""Steps after which nobody looks for them any longer."""
SQUASHED: Final = 4 / 3
"""Ratio of a picture's sides beyond which its user is warned that frames are square."""


@dataclass(frozen=True)
class Facts:
    """What an environment says of itself: widths of action and observation, the entry of info that says success (empty
    where there is none), all entries that info had, environment steps a second and in an episode (0: no limit), and
    whether MuJoCo knows its parts.
    """

    actions: int
    state: int
    success: str
    entries: tuple[str, ...]
    hz: float
    steps: int
    parts: bool


@contextmanager
def asked(name: str, expected: str) -> Iterator[None]:
    """Whatever a foreign environment raises, in one line."""
    try:
        yield
    except PlaySlotError:
        raise
    except Exception as error:
        raise ConfigError(
            f"env.id={name}: got {type(error).__name__} ({first_line(error)}), expected an environment {expected}, or "
            "choose another"
        ) from error


def first_steps(name: str) -> AbstractContextManager[None]:
    """`asked` for where an environment runs for the first time."""
    return asked(name, "whose first reset, steps and picture work: mend it, install what it needs")


@contextmanager
def _quiet() -> Iterator[None]:
    """Warnings of old versions and missing bounds, and what is printed at an import, are about others' code."""
    farama_notifications.notifications.pop("gymnasium_robotics", None)
    before, gym.logger.min_level = gym.logger.min_level, gym.logger.ERROR
    try:
        yield
    finally:
        gym.logger.min_level = before


def open_env(name: str) -> gym.Env[Any, Any]:
    """The environment of a Gymnasium id, without a limit of steps; a ConfigError where it is none that we can use."""
    import_mujoco()
    if not name:
        raise ConfigError("env.id: got nothing with env=gym, expected a Gymnasium id, such as env.id=FetchReach-v4")
    with _quiet(), asked(name, "that can be made: install what it needs"):
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        try:
            env: gym.Env[Any, Any] = gym.make(
                name, max_episode_steps=-1, render_mode="rgb_array", disable_env_checker=True
            )
        except gym.error.UnregisteredEnv as error:
            module, colon, own = name.rpartition(":")
            near = ", ".join(
                module + colon + one for one in difflib.get_close_matches(own, _current(), n=3, cutoff=0.0)
            )
            raise ConfigError(f"env.id: got {name!r}, expected a registered id; the nearest are {near}") from error
    space, modes, said = env.action_space, env.metadata.get("render_modes") or (), ""
    if not isinstance(space, gym.spaces.Box) or space.dtype.kind != "f":
        said = f"got actions {space}, expected a Box of real numbers"
    elif not np.prod(space.shape):
        said = f"got actions {space}, expected one number or more"
    elif not space.is_bounded("both"):
        said = f"got actions {space}, expected bounds below and above"
    elif "rgb_array" not in modes:
        said = f"got render_modes {list(modes)}, expected rgb_array among them"
    if said:
        env.close()
        raise ConfigError(f"env.id={name}: {said}; choose another environment, or wrap it under an id of your own")
    return env


def _current() -> list[str]:
    """The registered ids, without earlier versions of others, which often need what is gone."""
    by_version = sorted(gym.registry.values(), key=lambda spec: spec.version or 0)
    return [*{(spec.namespace, spec.name): spec.id for spec in by_version}.values()]


def flat(observation: Any) -> npt.NDArray[np.float32]:
    """An observation's numbers in one row, float32 (S,), without text and pictures, which are uint8 or have three axes;
    one zero where there are none.
    """
    rows = [np.ravel(part) for part in _parts(observation) if part.ndim < 2 + (part.dtype != np.uint8)]
    return np.concatenate(rows).astype(np.float32) if rows else np.zeros(1, np.float32)


def _parts(observation: Any) -> Iterator[npt.NDArray[Any]]:
    if isinstance(observation, dict | tuple | list):
        for part in observation.values() if isinstance(observation, dict) else observation:
            yield from _parts(part)
    elif (found := np.asarray(observation)).dtype.kind in "biuf":
        yield found


@functools.cache
def facts(name: str) -> Facts:
    """Found by steps of an episode: what an environment's info holds is declared nowhere."""
    env = open_env(name)
    with first_steps(name):
        try:
            observation, _ = env.reset(seed=0)
            (success, entries), parts = _said(env), is_mujoco(env)
            if not parts:
                _warn(name, *picture(env, name).shape[:2])
        finally:
            env.close()
    steps = gym.spec(env.spec.id).max_episode_steps if env.spec else None
    hz, actions = float(env.metadata.get("render_fps") or 10), int(np.prod(env.action_space.shape or ()))
    return Facts(actions, len(flat(observation)), success, entries, hz, steps or 0, parts)


def _said(env: gym.Env[Any, Any]) -> tuple[str, tuple[str, ...]]:
    """The first of `SUCCESS` that info holds in one of an episode's steps (some say it in the last alone), and all that
    it held until then.
    """
    box: Any = env.action_space
    middle, entries = ((box.low + box.high) / 2).astype(box.dtype), dict[str, None]()
    for _ in range(PROBED):
        *_, ended, cut, info = env.step(middle)
        entries |= dict.fromkeys(map(str, info))
        found = next((key for key in SUCCESS if key in info), "")
        if found or ended or cut:
            return found, tuple(entries)
    return "", tuple(entries)


def is_mujoco(env: gym.Env[Any, Any]) -> bool:
    """Whether an environment shows MuJoCo's model and data."""
    mj, core = import_mujoco(), env.unwrapped
    return isinstance(getattr(core, "model", None), mj.MjModel) and isinstance(getattr(core, "data", None), mj.MjData)


def picture(env: gym.Env[Any, Any], name: str) -> Frame:
    """What an environment draws, uint8 (H, W, 3), grey and transparent ones, too; a ConfigError where that is none."""
    drawn: Any = env.render()
    pixels = isinstance(drawn, np.ndarray) and drawn.ndim == 3 and drawn.dtype == np.uint8
    if not pixels or drawn.shape[2] not in (1, 3, 4):
        got = f"{drawn.dtype} {drawn.shape}" if isinstance(drawn, np.ndarray) else type(drawn).__name__
        raise ConfigError(
            f"env.id={name}: got {got} from render(), expected a picture, uint8 (H, W, 3): draw one there, or choose "
            "another"
        )
    colours: Frame = np.repeat(drawn, 3, axis=2) if drawn.shape[2] == 1 else drawn[..., :3]
    return colours


def _warn(name: str, height: int, width: int) -> None:
    if max(height, width) > SQUASHED * min(height, width):
        warnings.warn(
            f"env.id={name}: got pictures of {width} x {height} pixels, expected square ones: they are squashed",
            RuntimeWarning,
            stacklevel=3,
        )
