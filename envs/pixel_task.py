"""What our simulated tasks share: spaces, seeding, warm-up, agent steps and frames that are drawn only when wanted.

Shapes: A = 4, S = 4 (a subclass may have others), H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import chain
from typing import Any, ClassVar, Final, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.envs import without_expert
from playslot_rl.envs.rendering import FrameRenderer, import_mujoco
from playslot_rl.envs.variation import Variation
from playslot_rl.errors import ConfigError

ACTION_DIM: Final = 4
STATE_DIM: Final = 4

Action = npt.NDArray[np.float32]
Frame = npt.NDArray[np.uint8]


class Observation(dict[str, npt.NDArray[Any]]):
    """What a task shows, by the names of `keys.py`. "state", an older name of `keys.STATE`, still reads it."""

    def __missing__(self, key: str) -> npt.NDArray[Any]:
        if key != "state":
            raise KeyError(key)
        warnings.warn(f'observation["state"] is called "{keys.STATE}"', DeprecationWarning, stacklevel=2)
        return self[keys.STATE]


def check_actions(env: EnvConfig, actions: int = ACTION_DIM) -> None:
    """Refuse an `env.action_dim` other than the task's by a ConfigError."""
    if env.action_dim != actions:
        raise ConfigError(
            f"env.action_dim: got {env.action_dim}, expected {actions} for {env.name}: leave env.action_dim out, or "
            "give a task of your own `actions_of`"
        )


class PixelTask(gym.Env[Observation, Action]):
    """A task seen by one camera.

    Observations are `pixels`, uint8 [0, 255] (H, W, 3), and `state_vector`, float32 (4,); actions are float32 (4,) in
    [-1, 1]. An episode is a function of its seed alone: the task and the `warmup_steps` random agent steps before the
    first observation come from two independent streams of that seed. One agent step is `frame_skip` environment steps
    of the same action; `info["success"]` says whether any of them solved the task. Success does not terminate: clips
    have a fixed length, `max_steps`.

    `draw_steps` False makes `step` return the last frame that was drawn instead of a new one, for controllers that do
    not look at it: rendering is most of a step's time. `reset` always draws, unless `draw_resets` is False.
    """

    _simulation: Any  # MuJoCo's `model` and `data`, and `close`; made by the subclass, as is the next one
    _make_renderer: Callable[[], FrameRenderer]
    solves = True
    """Whether success is measured; else the return is."""
    has_expert = False
    """Whether `expert_action` shows how it is solved: true of a class that writes one, unless it says otherwise."""
    distance_seen: float = 1.0
    """Metres from the camera to the middle of what happens."""
    still: ClassVar[tuple[str, ...]] = ()
    """Bodies of an object that stay where they are and look like ground."""
    scenery: ClassVar[bool] = True
    """Whether what belongs to none of `objects` is scenery, which `env.variation` may paint over; else planes alone."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "expert_action" in cls.__dict__:
            cls.has_expert = bool(cls.__dict__.get("has_expert", True))

    def __init__(
        self, config: EnvConfig, render_mode: str | None, *, actions: int = ACTION_DIM, state: int = STATE_DIM
    ) -> None:
        check_actions(config, actions)
        self.config, self.render_mode = config, render_mode
        size = config.image_size
        space = gym.spaces.Dict(
            {
                keys.PIXELS: gym.spaces.Box(0, 255, (size, size, 3), np.uint8),
                keys.STATE: gym.spaces.Box(-np.inf, np.inf, (state,), np.float32),
            }
        )
        self.observation_space = cast(gym.Space[Observation], space)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (actions,), np.float32)
        self._frame: Frame | None = None
        self._steps = self.episode = 0
        self.draw_steps = self.draw_resets = True
        self._variation: Variation | None = None

    @classmethod
    def actions_of(cls, config: EnvConfig) -> int:
        """Width A of the actions of the task with this config."""
        del config
        return ACTION_DIM

    @classmethod
    def in_mujoco(cls, config: EnvConfig) -> bool:
        """Whether `FrameRenderer` draws a scene of MuJoCo, whose parts are known and which `env.variation` changes; a
        class that draws itself opens none.
        """
        del config
        return cls.open_renderer is PixelTask.open_renderer

    @cached_property
    def _renderer(self) -> FrameRenderer:
        """Made with the first episode: a process that is forked from one with a GL context cannot draw."""
        variation = self.config.variation
        if not variation.on:
            return self._make_renderer()
        make: Any = self._make_renderer
        renderer: FrameRenderer = make(still=None, at_rest=False) if variation.shake else make()
        (arm, *others), model = list(self.objects()) or [()], self._simulation.model
        things, coloured = ({*arm, *chain(*others)}, {*arm}) if self.scenery else (None, set[str]())
        self._variation = Variation(variation, model, things, coloured, self.distance_seen)
        renderer.vary(self._variation)
        return renderer

    def open_renderer(self) -> None:
        """Make the GL context now, not with the first episode; a RenderError where there is none."""
        assert self._renderer is not None

    def _vary(self) -> None:
        """Draw how the episode varies."""
        if self._variation is not None:
            self._variation.begin(self.episode, self._renderer.side)

    @abstractmethod
    def _begin(self, rng: np.random.Generator) -> None:
        """Put the simulation into a new episode, drawn from `rng`."""

    @abstractmethod
    def _advance(self, action: Action) -> tuple[float, bool]:
        """One environment step: its reward, and whether it solved the task."""

    @abstractmethod
    def _solved(self) -> bool:
        """Whether the task is solved in the present state."""

    @abstractmethod
    def _state(self) -> npt.NDArray[np.float32]:
        """Proprioception, float32 (4,)."""

    def expert_action(self) -> Action:
        """Action of the scripted expert for the present state: float32 (4,) in [-1, 1]; a ConfigError without one."""
        raise without_expert(self.config)

    def _simulate(self, action: Action) -> tuple[float, bool]:
        """One agent step: its mean reward, and whether any of its environment steps solved the task. Where returns are
        measured, it is their sum: these must not depend on `frame_skip`."""
        reward, success = 0.0, False
        for _ in range(self.config.frame_skip):
            step_reward, solved = self._advance(action)
            reward += step_reward
            success |= solved
        return reward / self.config.frame_skip if self.solves else reward, success

    def draw(self) -> Frame:
        """Draw the present state anew: uint8 (H, W, 3). `render` returns the frame that was last observed."""
        if self._variation is not None:
            self._variation.step = self._steps
        return self._renderer(self._simulation.data)

    @abstractmethod
    def objects(self) -> Sequence[Sequence[str]]:
        """What a viewer calls one thing: for each, the names of its root bodies, or of sites of the world."""

    @abstractmethod
    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        """Where the arm's hand and the movable things are: name -> (3,) metres; as many in each step of an episode."""

    def segment(self) -> npt.NDArray[np.int64]:
        """Which object each pixel shows: int64 (H, W), o + 1 for `objects()[o]`, 0 for the ground; a ConfigError where
        MuJoCo does not know.
        """
        if not self.in_mujoco(self.config):
            raise ConfigError(f"env={self.config.full_name}: got a task that draws itself, expected one in MuJoCo")
        model, found = self._simulation.model, self._renderer.parts(self._simulation.data)
        number = {name: label for label, names in enumerate(self.objects(), 1) for name in names}
        kinds = import_mujoco().mjtObj
        labels = np.zeros(found.shape[:2], np.int64)
        bodies = {int(kinds.mjOBJ_GEOM): model.geom_bodyid, int(kinds.mjOBJ_SITE): model.site_bodyid}
        for part, kind in np.unique(found.reshape(-1, 2), axis=0).tolist():
            if kind not in bodies:
                continue
            body = bodies[kind][part]
            name = model.body(model.body_rootid[body]).name
            if body == 0 and kind == kinds.mjOBJ_SITE:
                name = model.site(part).name
            if model.body(body).name not in self.still:
                labels[(found == (part, kind)).all(-1)] = number.get(name, 0)
        return labels

    def close(self) -> None:
        if "_renderer" in self.__dict__:
            self._renderer.close()
        self._simulation.close()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of a seed; None draws one from the environment's generator. `{"success": True}` is an
        episode that starts solved, which only random warm-up steps can make.
        """
        del options
        self.open_renderer()
        super().reset(seed=seed)
        self.episode = int(self.np_random.integers(2**31)) if seed is None else seed
        task, warmup = (np.random.default_rng(s) for s in np.random.SeedSequence(self.episode).spawn(2))
        self._begin(task)
        self._vary()
        for _ in range(self.config.warmup_steps):
            self._simulate(warmup.uniform(-1.0, 1.0, self.action_space.shape).astype(np.float32))
        self._steps = 0
        return self._observe(self.draw_resets), {"success": self._solved()}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One agent step of an action (A,), clipped to [-1, 1]; a ValueError where it is of another shape, or not
        finite.
        """
        action, shape = np.asarray(action, np.float32), self.action_space.shape
        if action.shape != shape or not np.isfinite(action).all():
            raise ValueError(f"action: got {action!r}, expected {self.config.action_dim} finite numbers in [-1, 1]")
        reward, success = self._simulate(np.clip(action, -1.0, 1.0))
        self._steps += 1
        if not np.isfinite(reward):
            raise self._not_finite("a reward")
        return self._observe(self.draw_steps), reward, False, self._steps >= self.config.max_steps, {"success": success}

    def _observe(self, draw: bool) -> Observation:
        if draw or self._frame is None:
            self._frame = self._fitting(keys.PIXELS, self.draw())
        state = np.asarray(self._state(), np.float32)
        if not np.isfinite(state).all():
            raise self._not_finite(keys.STATE)
        return Observation({keys.PIXELS: self._frame, keys.STATE: self._fitting(keys.STATE, state)})

    def _not_finite(self, what: str) -> ConfigError:
        return ConfigError(
            f"{' '.join(self.config.typed)}: got {what} that is NaN or infinite in agent step {self._steps} of episode "
            f"{self.episode}, expected finite numbers: mend the task, or choose another"
        )

    def _fitting(self, key: str, part: Any) -> Any:
        """A part of an observation; a ConfigError where it is of another kind or shape than its space."""
        space: Any = cast(gym.spaces.Dict, self.observation_space)[key]
        if not isinstance(part, np.ndarray) or (part.dtype, part.shape) != (space.dtype, space.shape):
            got = f"{part.dtype} {part.shape}" if isinstance(part, np.ndarray) else type(part).__name__
            raise ConfigError(
                f"env={self.config.full_name}: got {key} {got}, expected {space.dtype} {space.shape}: change what the "
                "task draws, or the width it states (state=)"
            )
        return part

    def render(self) -> Frame | None:
        """The present frame, uint8 (H, W, 3); None without a render mode or before the first reset."""
        if self.render_mode is None or self._frame is None:
            return None
        return self._frame.copy()
