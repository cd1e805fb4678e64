"""Tasks of the DeepMind Control Suite (dm-control 1.0.28, the extra `dmc`), whose learning curves are published.

Shapes: A = the task's actions, S = its own observation, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs import dmc_config, dmc_ids
from playslot_rl.envs.pixel_task import Action, PixelTask, check_actions
from playslot_rl.envs.rendering import FrameRenderer, import_mujoco
from playslot_rl.errors import ConfigError

PREFIX: Final = "dmc_"
CAMERA: Final = 0


def load_suite() -> Any:
    """`dm_control.suite`; a ConfigError where dm-control is not installed."""
    import_mujoco()
    try:
        from dm_control import suite
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"env={PREFIX}...: got no package {error.name}, expected dm-control: pip install 'playslot_rl[dmc]'"
        ) from error
    return suite


def suite_task(name: str) -> tuple[str, str]:
    """Domain and task that `dmc_DOMAIN_TASK` names; a ConfigError where the suite has none of that name."""
    known = {f"{PREFIX}{domain}_{task}": (domain, task) for domain, task in load_suite().ALL_TASKS}
    if name not in known:
        raise ConfigError(f"env.name: got {name!r}, expected one of {', '.join(sorted(known))}")
    return known[name]


class DMControlTask(PixelTask):
    """The task `dmc_DOMAIN_TASK` of the suite, seen by its camera 0.

    The reward of an agent step is the *sum* of its environment steps' (0 to 1 each), so that the return of 1000 of them
    is what is published. Nothing counts as success, nothing ends an episode but `max_steps`, and there is no scripted
    expert. `state_vector` is the suite's own observation, flat.

    Note: frames of `render.quality=full` are dm-control's, pixel for pixel; `fast` draws no shadows or reflections and
    averages boxes instead of samples.
    """

    solves = False
    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array"],
        "render_fps": 50,
        "control_hz": 100,
        "task": "Collect the task's rewards.",
        "action": "the task's own actuators",
    }

    @classmethod
    def actions_of(cls, config: EnvConfig) -> int:
        """Of a task that has settings here; others are looked at when they are made."""
        known = {env.name: env.action_dim for _, env in dmc_ids().values()}
        return known.get(config.name, config.action_dim)

    @classmethod
    def metadata_of(cls, env: EnvConfig) -> dict[str, Any]:
        """`metadata` of a task that has settings here."""
        return {**cls.metadata, **_SAID.get(env.name, {})}

    def __init__(
        self, env: EnvConfig | None = None, render: RenderConfig | None = None, render_mode: str | None = "rgb_array"
    ) -> None:
        config = env or dmc_config("dmc_cartpole_balance", 1)
        domain, task = suite_task(config.name)
        self._suite = load_suite().load(domain, task, task_kwargs={"time_limit": float("inf"), "random": 0})
        self._last = self._suite.reset()
        actions = self._suite.action_spec().shape[0]
        check_actions(config, actions)
        super().__init__(config, render_mode, actions=actions, state=len(self._state()))
        self._simulation = _Simulation(self._suite)
        model = self._simulation.model
        self._make_renderer = partial(
            FrameRenderer, model, model.camera(CAMERA).name, config.image_size, render or RenderConfig()
        )

    def _begin(self, rng: np.random.Generator) -> None:
        # The suite draws from numpy's older generator.
        self._suite.task._random = np.random.RandomState(int(rng.integers(2**32)))
        self._last = self._suite.reset()

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._last = self._suite.step(action)
        return float(self._last.reward), False

    def _solved(self) -> bool:
        return False

    def _state(self) -> npt.NDArray[np.float32]:
        values = [np.ravel(value) for value in self._last.observation.values()]
        return np.concatenate(values).astype(np.float32)

    def objects(self) -> tuple[tuple[str, ...], ...]:
        return tuple((name,) for name in self._bodies() if self._simulation.model.body(name).parentid == 0)

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        return {name: self._simulation.data.body(name).xpos.copy() for name in self._bodies()}

    def _bodies(self) -> list[str]:
        """All but the world's."""
        model = self._simulation.model
        return [model.body(i).name for i in range(1, model.nbody)]


class _Simulation:
    """MuJoCo's own model and data under dm-control's, which both stay the same for the life of a task."""

    def __init__(self, suite: Any) -> None:
        self._suite = suite
        self.model, self.data = suite.physics.model.ptr, suite.physics.data.ptr

    def close(self) -> None:
        self._suite.close()


_SAID: Final[dict[str, dict[str, Any]]] = {
    "dmc_cartpole_balance": {"task": "Keep the pole upright.", "action": "force on the cart"},
    "dmc_ball_in_cup_catch": {
        "task": "Catch the ball in the cup.",
        "action": "force on the cup, sideways and up",
        "control_hz": 50,
        "render_fps": 25,
    },
}
