"""Simulated tasks: Gymnasium environments and their TorchRL form. Everything is imported when first used."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any, Protocol, cast

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.errors import ConfigError

if TYPE_CHECKING:
    import gymnasium as gym
    import numpy as np
    import numpy.typing as npt
    from torchrl.envs import EnvBase

ENVIRONMENTS: dict[str, tuple[str, str]] = {
    "button_press": ("PlaySlot/ButtonPress-v0", "playslot_rl.envs.button_press:ButtonPressEnv"),
    "block_push": ("PlaySlot/BlockPush-v0", "playslot_rl.envs.block_push:BlockPushEnv"),
    "block_push_easy": ("PlaySlot/BlockPushEasy-v0", "playslot_rl.envs.block_push:BlockPushEnv"),
    "block_reach": ("PlaySlot/BlockReach-v0", "playslot_rl.envs.block_push:BlockReachEnv"),
    "block_pick": ("PlaySlot/BlockPick-v0", "playslot_rl.envs.block_push:BlockPickEnv"),
}
"""Name in the configuration -> Gymnasium id and entry point; `block_ids.py` has more ids of the blocks family."""

PROCEDURAL = ("grid_shapes",)
"""Environments that are drawn, not simulated: they give videos, there is nothing to act on and no success."""

RECORDED = ("sketchy",)
"""Names of data sets recorded on real robots: settings for training on them."""


class TaskEnv(Protocol):
    """What the collectors and the evaluation need of an environment, beyond Gymnasium's own interface."""

    config: EnvConfig

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the episode of `seed`; `info["success"]` is True where it starts solved."""

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One agent step; `info["success"]` says whether it solved the task."""

    def expert_action(self) -> npt.NDArray[np.float32]:
        """The scripted expert's action for the present state, (A,) in [-1, 1]."""

    def close(self) -> None:
        """Free the renderer."""


def register() -> None:
    """Register the Gymnasium ids; calling it again does nothing. Called by `make_env` and by Gymnasium's plug-ins."""
    from gymnasium.envs.registration import register as gym_register
    from gymnasium.envs.registration import registry

    from playslot_rl.envs.block_ids import family

    wanted: dict[str, tuple[str, dict[str, Any]]] = {name: (entry, {}) for name, entry in ENVIRONMENTS.values()}
    wanted.update({name: (entry, {"env": config}) for name, (entry, config) in family().items()})
    for name, (entry, kwargs) in wanted.items():
        if name not in registry:
            gym_register(id=name, entry_point=entry, order_enforce=False, disable_env_checker=True, kwargs=kwargs)


def gym_id(name: str) -> str:
    """Gymnasium id of a configured environment name.

    Raises:
        ConfigError: there is no such environment.
    """
    if name in (*PROCEDURAL, *RECORDED):
        known = ", ".join(sorted(ENVIRONMENTS))
        raise ConfigError(f"env={name}: got an environment without a simulator, expected one of {known}")
    if name not in ENVIRONMENTS:
        near = difflib.get_close_matches(name, ENVIRONMENTS, n=1)
        hint = f"; did you mean env={near[0]}?" if near else "; choose one of these"
        raise ConfigError(f"unknown environment: got {name!r}, expected one of {', '.join(sorted(ENVIRONMENTS))}{hint}")
    return ENVIRONMENTS[name][0]


def make_env(env: EnvConfig | None = None, render: RenderConfig | None = None) -> gym.Env[Any, Any]:
    """Make a task as a Gymnasium environment without wrappers, so that `expert_action()` can be called on it.

    Observations: `{"pixels": uint8 (H, W, 3), "state": float32 (S,)}`; actions float32 (A,) in [-1, 1];
    `info["success"]: bool` from `reset` and `step`.

    Raises:
        ConfigError: unknown environment name.
        RenderError: there is no working GL backend.
    """
    env = env or EnvConfig()
    name = gym_id(env.name)
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()
    import gymnasium

    register()
    return gymnasium.make(name, env=env, render=render or RenderConfig(), render_mode="rgb_array")


def task_env(env: gym.Env[Any, Any]) -> TaskEnv:
    """The task under any Gymnasium wrappers."""
    return cast(TaskEnv, env.unwrapped)


def task_metadata(env: EnvConfig) -> dict[str, Any]:
    """Gymnasium's metadata of a task, without making it: `control_hz`, `task` (a sentence), `action` (its numbers).

    Raises:
        ConfigError: there is no such environment, or it has no simulator.
    """
    name = gym_id(env.name)
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    register()
    entry_point = gymnasium.spec(name).entry_point
    creator: Any = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    describe = getattr(creator, "metadata_of", None)  # a family of tasks says what is to be done in each
    metadata: dict[str, Any] = creator.metadata if describe is None else describe(env)
    return metadata


def make_torchrl_env(env: EnvConfig | None = None, render: RenderConfig | None = None) -> EnvBase:
    """Make a task in its TorchRL form; see `playslot_rl.envs.torchrl`."""
    from playslot_rl.envs.torchrl import make_torchrl_env as make

    return make(env or EnvConfig(), render or RenderConfig())


__all__ = [
    "ENVIRONMENTS",
    "PROCEDURAL",
    "RECORDED",
    "TaskEnv",
    "gym_id",
    "make_env",
    "make_torchrl_env",
    "register",
    "task_env",
    "task_metadata",
]
