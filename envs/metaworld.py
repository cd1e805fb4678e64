"""The fifty tasks of Meta-World 3.1.1: a Sawyer arm on a table; ButtonPress is one of them, with a name of its own.

Shapes: A = 4, S = 4, H = W = `EnvConfig.image_size`.
"""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.families import member, task_name
from playslot_rl.config.metaworld import NEAR, VERSION
from playslot_rl.envs.gym_scene import distance_seen, view
from playslot_rl.envs.pixel_task import ACTION_DIM, STATE_DIM, Action, Frame, PixelTask
from playslot_rl.envs.rendering import Camera, FrameRenderer, import_mujoco

CAMERA: Final = Camera(distance=1.25, azimuth=145.0, elevation=-40.0, lookat=(-0.05, 0.75, 0.0))
MIRRORED: Final = Camera(distance=1.25, azimuth=35.0, elevation=-40.0, lookat=(0.05, 0.75, 0.0))
WIDE: Final = Camera(distance=1.7, azimuth=145.0, elevation=-40.0, lookat=(0.0, 0.75, 0.05))
CAMERAS: Final[dict[str, Camera]] = {
    **dict.fromkeys(("handle-press-side", "handle-pull-side", "peg-insert-side", "peg-unplug-side"), MIRRORED),
    **dict.fromkeys(("door-close", "shelf-place", "stick-pull", "stick-push", "sweep"), WIDE),
}
"""Of the tasks whose object the arm hides from `CAMERA`, or whose goal that cuts off."""
CLOSE: Final = Camera(distance=0.8, azimuth=180.0, elevation=-35.0, lookat=(0.0, 0.68, 0.12))
"""`env.camera=near`: across the table, where the arm stands beside the things, from two thirds as far."""
HELD: Final = ("button-press", "assembly", "disassemble", "handle-pull", "pick-out-of-hole", "pick-place-wall")
"""Tasks whose expert's first action is held for the agent step: ButtonPress, as ever, and where that is quicker."""
LATE: Final = ("dial-turn", "peg-unplug-side", "window-close", "window-open")
"""Tasks whose rewards depend on what their reset finds: the object's place, or the plug's spin, as the last one left
them."""
ROBOT: Final = ("base", "hand")
PEDESTAL = ("base", "controller_box", "pedestal_feet", "pedestal", "torso", "right_arm_base_link")
GROUND: Final = ("tablelink", "RetainingWall", "mocap", "")
HAND_STATE = slice(0, STATE_DIM)
"""Part of Meta-World's observation that is proprioception: hand xyz (metres) and gripper opening [0, 1]."""
OBJECT: Final = 7
"""Numbers of an object in Meta-World's observation, after the hand's: place (3,), metres, and turn (4,)."""


class MetaWorldEnv(PixelTask):
    """The task `EnvConfig.task`, or ButtonPress; see `PixelTask`.

    `state_vector` is the hand's xyz in metres and the gripper's opening, an action the hand's displacement xyz and the
    gripper's effort. The reward of an agent step is the mean of its environment steps' (0 to 10). Solved is what
    Meta-World calls so.
    """

    still = PEDESTAL
    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array"],
        "render_fps": 16,
        "control_hz": 80,
        "task": "",
        "action": "hand displacement x, y, z and gripper effort",
    }
    """`control_hz` counts environment steps: an agent step of `frame_skip` of them takes `frame_skip / 80` seconds."""

    @classmethod
    def metadata_of(cls, config: EnvConfig) -> dict[str, Any]:
        """Gymnasium's metadata with the sentence that says what is to be done."""
        return {**cls.metadata, "task": member(config.name, config.task).sentence}

    def __init__(
        self,
        env: EnvConfig | None = None,
        render: RenderConfig | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        super().__init__(env or EnvConfig(), render_mode)
        self.metadata = self.metadata_of(self.config)
        import_mujoco()
        from metaworld.env_dict import ENV_CLS_MAP
        from metaworld.policies import ENV_POLICY_MAP

        task = task_name(self.config.name, self.config.task)
        self._simulation = ENV_CLS_MAP[task + VERSION]()
        self._simulation._set_task_called = True
        self._simulation._freeze_rand_vec = False
        self._simulation.seeded_rand_vec = True
        self._simulation._partially_observable = False  # experts are told the goal
        del self._simulation.sawyer_observation_space  # cached, without it
        # Meta-World's own horizon counts environment steps; ours counts agent steps.
        self._simulation.max_path_length = np.iinfo(np.int64).max
        policies: dict[str, Any] = ENV_POLICY_MAP
        self._expert = policies[task + VERSION]()
        self._held, self._late = task in HELD, task in LATE
        model, (camera, at_rest) = self._simulation.model, self._view(task)
        self.distance_seen = distance_seen(model, camera)
        self._make_renderer = partial(
            FrameRenderer, model, camera, self.config.image_size, render or RenderConfig(), at_rest=at_rest
        )
        self._moved = [(table, table.copy()) for table in (model.body_pos, model.body_quat, model.site_pos)]
        self._full: npt.NDArray[np.float64] = np.zeros(0)

    def _view(self, task: str) -> tuple[Any, bool]:
        """What a `FrameRenderer` looks through, and whether it is at rest: the hand carries one of the cameras."""
        if self.config.camera in ("", NEAR):
            return CLOSE if self.config.camera else CAMERAS.get(task, CAMERA), True
        return view(self._simulation, self._simulation.model, self.config.camera)

    def _begin(self, rng: np.random.Generator) -> None:
        """Meta-World's reset done once, where that is the same: its own runs the hand's 50 settling steps twice."""
        import mujoco

        env = self._simulation
        env.np_random = rng
        env.curr_path_length = 0
        mujoco.mj_resetData(env.model, env.data)
        for table, before in self._moved:  # the hand settles before the last episode's objects are moved
            table[:] = before
        env.reset_model()
        if self._late:  # the same draw, on the model that the first reset has moved
            env._freeze_rand_vec = True
            mujoco.mj_resetData(env.model, env.data)
            env.reset_model()
            env._freeze_rand_vec = False
        mujoco.mj_kinematics(env.model, env.data)  # some tasks place their object after all else
        self._full = env._get_obs()
        self._full[18:36] = env._prev_obs = self._full[:18].copy()

    def objects(self) -> tuple[tuple[str, ...], ...]:
        model = self._simulation.model
        roots = (model.body(body).name for body in range(1, model.nbody) if model.body_parentid[body] == 0)
        goals = (model.site(i).name for i in np.flatnonzero((model.site_bodyid == 0) & (model.site_rgba[:, 3] > 0)))
        return ROBOT, *((name,) for name in (*roots, *goals) if name not in (*GROUND, *ROBOT))

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        count = len(self._simulation._get_pos_objects()) // 3
        starts = (STATE_DIM + OBJECT * i for i in range(count))
        things = {f"object{i}": self._full[at : at + 3].copy() for i, at in enumerate(starts)}
        return {"hand": self._full[:3].copy(), **things}

    @contextlib.contextmanager
    def _goals_in_place(self) -> Iterator[None]:
        """Meta-World puts a goal's marker where it is by hand, and then computes all places anew."""
        data = self._simulation.data
        kept = data.site_xpos.copy()
        for name, place in self._simulation._target_site_config:
            data.site(name).xpos[:] = place[:3]
        try:
            yield
        finally:
            data.site_xpos[:] = kept

    def draw(self) -> Frame:
        with self._goals_in_place():
            return super().draw()

    def segment(self) -> npt.NDArray[np.int64]:
        with self._goals_in_place():
            return super().segment()

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._full, reward, _, _, info = self._simulation.step(action)
        return float(reward), bool(info["success"])

    def _solved(self) -> bool:
        _, info = self._simulation.evaluate_state(self._full, np.zeros(ACTION_DIM, np.float32))
        return bool(info["success"])

    def _state(self) -> npt.NDArray[np.float32]:
        return self._full[HAND_STATE].astype(np.float32)

    def expert_action(self) -> Action:
        """What Meta-World's expert, who chooses anew at each environment step, does on average in the next agent step:
        its steps are tried on a copy of the simulation. In the tasks `HELD` it is its first action.
        """
        if self._held:
            return self._choice(self._full)
        env, seen = self._simulation, self._full
        kept, env.data = dict(env.__dict__), copy.copy(env.data)
        actions = []
        try:
            for _ in range(self.config.frame_skip):
                actions.append(self._choice(seen))
                seen = env.step(actions[-1])[0]
        finally:
            env.__dict__.clear()
            env.__dict__.update(kept)
        mean: Action = np.mean(actions, axis=0, dtype=np.float32)
        return mean

    def _choice(self, seen: npt.NDArray[np.float64]) -> Action:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that its gain exceeds the clip, which is how it is meant
            action = self._expert.get_action(seen)
        return np.asarray(np.clip(action, -1.0, 1.0), np.float32)
