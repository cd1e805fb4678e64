"""ButtonPress: a Sawyer arm and a red button (Meta-World 3.1.1, `button-press-v3`).

Shapes: A = 4, S = 4, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs.pixel_task import ACTION_DIM, STATE_DIM, Action, PixelTask
from playslot_rl.envs.rendering import Camera, FrameRenderer, import_mujoco

CAMERA = Camera(distance=1.25, azimuth=145.0, elevation=-40.0, lookat=(-0.05, 0.75, 0.0))
PEDESTAL = ("base", "controller_box", "pedestal_feet", "pedestal", "torso", "right_arm_base_link")
HAND_STATE = slice(0, STATE_DIM)
"""Part of Meta-World's observation that is proprioception: hand xyz (metres) and gripper opening [0, 1]."""


class ButtonPressEnv(PixelTask):
    """Press the button; see `PixelTask`.

    `state_vector` is the hand's xyz in metres and the gripper's opening, an action the hand's displacement xyz and the
    gripper's effort. The reward of an agent step is the mean of its environment steps' (0 to 10).
    """

    still, distance_seen = PEDESTAL, CAMERA.distance
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
        super().__init__(env or EnvConfig(), render_mode)
        import_mujoco()
        from metaworld.envs.sawyer_button_press_v3 import SawyerButtonPressEnvV3
        from metaworld.policies.sawyer_button_press_v3_policy import SawyerButtonPressV3Policy

        self._simulation = SawyerButtonPressEnvV3()
        self._simulation._set_task_called = True
        self._simulation._freeze_rand_vec = False
        self._simulation.seeded_rand_vec = True
        # Meta-World's own horizon counts environment steps; ours counts agent steps.
        self._simulation.max_path_length = np.iinfo(np.int64).max
        self._expert = SawyerButtonPressV3Policy()
        model = self._simulation.model
        self._make_renderer = partial(FrameRenderer, model, CAMERA, self.config.image_size, render or RenderConfig())
        self._full: npt.NDArray[np.float64] = np.zeros(0)

    def _begin(self, rng: np.random.Generator) -> None:
        """Meta-World's reset done once: its own `reset` runs the hand's 50 settling steps twice."""
        import mujoco

        env = self._simulation
        env.np_random = rng
        env.curr_path_length = 0
        mujoco.mj_resetData(env.model, env.data)
        self._full = env.reset_model()
        env._prev_obs = self._full[:18].copy()

    def objects(self) -> tuple[tuple[str, ...], ...]:
        return ("base", "hand"), ("box",)

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        return {"hand": self._full[:3].copy(), "button": self._full[4:7].copy()}

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._full, reward, _, _, info = self._simulation.step(action)
        return float(reward), bool(info["success"])

    def _solved(self) -> bool:
        _, info = self._simulation.evaluate_state(self._full, np.zeros(ACTION_DIM, np.float32))
        return bool(info["success"])

    def _state(self) -> npt.NDArray[np.float32]:
        return self._full[HAND_STATE].astype(np.float32)

    def expert_action(self) -> Action:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that its gain exceeds the clip, which is how it is meant
            action = self._expert.get_action(self._full)
        return np.clip(action, -1.0, 1.0).astype(np.float32)
