"""ButtonPress: a Sawyer arm and a red button (Meta-World 3.1.1, `button-press-v3`).

Shapes: A = 4, S = 4, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import warnings
from typing import Any, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs.rendering import Camera, FrameRenderer, import_mujoco
from playslot_rl.errors import ConfigError

CAMERA = Camera(distance=1.25, azimuth=145.0, elevation=-40.0, lookat=(-0.05, 0.75, 0.0))
ACTION_DIM = 4
STATE_DIM = 4
HAND_STATE = slice(0, STATE_DIM)
"""Part of Meta-World's observation that is proprioception: hand xyz (metres) and gripper opening [0, 1]."""

Observation = dict[str, npt.NDArray[Any]]


class ButtonPressEnv(gym.Env[Observation, npt.NDArray[np.float32]]):
    """Press the button.

    Observations are `pixels`, uint8 [0, 255] (H, W, 3), and `state`, float32 (4,): hand xyz in metres and the gripper's
    opening. Actions are float32 (4,) in [-1, 1]: hand displacement xyz and gripper effort. One agent step is
    `frame_skip` environment steps of the same action; its reward is their mean (0 to 10), and `info["success"]` says
    whether any of them solved the task. Success does not terminate: clips have a fixed length, `max_steps`.

    An episode is a function of its seed alone: the button's place and the `warmup_steps` random agent steps before the
    first observation come from two independent streams of that seed.

    Args:
        env: the task; None means the defaults.
        render: how frames are drawn; None means the defaults.
        render_mode: `rgb_array` or None.

    Attributes:
        draw_steps: False makes `step` return the last frame that was drawn instead of a new one, for controllers that
            do not look at it: rendering is nine tenths of a step's time. `reset` always draws.

    Raises:
        ConfigError: `env.action_dim` is not 4.
        RenderError: there is no working GL backend.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array"],
        "render_fps": 16,
        "control_hz": 80,
        "task": "Press the red button.",
        "action": "hand displacement x, y, z and gripper effort",
    }
    """`control_hz` counts environment steps: an agent step of `frame_skip` of them takes `frame_skip / 80` seconds."""

    def __init__(
        self,
        env: EnvConfig | None = None,
        render: RenderConfig | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        self.config = env or EnvConfig()
        if self.config.action_dim != ACTION_DIM:
            raise ConfigError(f"env.action_dim: got {self.config.action_dim}, expected {ACTION_DIM} for button_press")
        import_mujoco()
        from metaworld.envs.sawyer_button_press_v3 import SawyerButtonPressEnvV3
        from metaworld.policies.sawyer_button_press_v3_policy import SawyerButtonPressV3Policy

        self._env = SawyerButtonPressEnvV3()
        self._env._set_task_called = True
        self._env._freeze_rand_vec = False
        self._env.seeded_rand_vec = True
        # Meta-World's own horizon counts environment steps; ours counts agent steps.
        self._env.max_path_length = np.iinfo(np.int64).max
        self._expert = SawyerButtonPressV3Policy()
        size = self.config.image_size
        self._renderer = FrameRenderer(self._env.model, CAMERA, size, render or RenderConfig())
        self.render_mode = render_mode
        space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Box(0, 255, (size, size, 3), np.uint8),
                "state": gym.spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32),
            }
        )
        self.observation_space = cast(gym.Space[Observation], space)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self._full: npt.NDArray[np.float64] = np.zeros(0)
        self._frame: npt.NDArray[np.uint8] | None = None
        self._steps = 0
        self.draw_steps = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: the episode's seed; None draws the next one from the environment's generator.
            options: unused.

        Returns:
            The first observation and `{"success": bool}`: True for an episode that starts solved.
        """
        del options
        super().reset(seed=seed)
        episode = int(self.np_random.integers(2**31)) if seed is None else seed
        task, warmup = (np.random.default_rng(s) for s in np.random.SeedSequence(episode).spawn(2))
        self._reset_simulation(task)
        for _ in range(self.config.warmup_steps):
            self._simulate(warmup.uniform(-1.0, 1.0, ACTION_DIM).astype(np.float32))
        self._steps = 0
        _, info = self._env.evaluate_state(self._full, np.zeros(ACTION_DIM, np.float32))
        return self._observe(), {"success": bool(info["success"])}

    def _reset_simulation(self, rng: np.random.Generator) -> None:
        """Meta-World's reset done once: its own `reset` runs the hand's 50 settling steps twice."""
        import mujoco

        env = self._env
        env.np_random = rng
        env.curr_path_length = 0
        mujoco.mj_resetData(env.model, env.data)
        self._full = env.reset_model()
        env._prev_obs = self._full[:18].copy()

    def _simulate(self, action: npt.NDArray[np.float32]) -> tuple[float, bool]:
        reward, success = 0.0, False
        for _ in range(self.config.frame_skip):
            self._full, step_reward, _, _, info = self._env.step(action)
            reward += float(step_reward)
            success |= bool(info["success"])
        return reward / self.config.frame_skip, success

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One agent step.

        Args:
            action: float (4,), clipped to [-1, 1].

        Raises:
            ValueError: an action of another shape, or not finite.
        """
        action = np.asarray(action, np.float32)
        if action.shape != (ACTION_DIM,) or not np.isfinite(action).all():
            raise ValueError(f"action: got {action!r}, expected {ACTION_DIM} finite numbers in [-1, 1]")
        reward, success = self._simulate(np.clip(action, -1.0, 1.0))
        self._steps += 1
        return self._observe(self.draw_steps), reward, False, self._steps >= self.config.max_steps, {"success": success}

    def expert_action(self) -> npt.NDArray[np.float32]:
        """Action of Meta-World's scripted expert for the present state: float32 (4,) in [-1, 1]."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that its gain exceeds the clip, which is how it is meant
            action = self._expert.get_action(self._full)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _observe(self, draw: bool = True) -> Observation:
        if draw or self._frame is None:
            self._frame = self.draw()
        return {"pixels": self._frame, "state": self._full[HAND_STATE].astype(np.float32)}

    def draw(self) -> npt.NDArray[np.uint8]:
        """Draw the present state anew: uint8 (H, W, 3). `render` returns the frame that was last observed."""
        return self._renderer(self._env.data)

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The present frame, uint8 (H, W, 3); None without a render mode or before the first reset."""
        if self.render_mode is None or self._frame is None:
            return None
        return self._frame.copy()

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()
        self._env.close()
