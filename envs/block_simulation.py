"""The simulation of the blocks family: gymnasium-robotics' `MujocoFetchEnv` on our scene.

Import it after `playslot_rl.envs.rendering.import_mujoco` was called.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from playslot_rl.envs.block_layout import Layout, Variant
from playslot_rl.envs.block_scene import CUBE, SMALL_CUBE, asset, build_spec, import_fetch, parking_place

SUBSTEPS = 20
"""Simulation steps of 2 ms in an environment step: 25 Hz."""
ROBOT_START = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}

Vector = npt.NDArray[np.float64]

MujocoFetchEnv: Any = import_fetch().MujocoFetchEnv


class BlockSimulation(MujocoFetchEnv):
    """Arm, table and objects; `place` starts an episode, `advance` runs one environment step.

    Args:
        variant: decides objects and gripper.
        count: most objects that an episode has.

    Attributes:
        start_grip: (3,) where the grip is at the start of every episode, metres.
    """

    def __init__(self, variant: Variant, count: int) -> None:
        self.variant, self.count = variant, count
        self.half = SMALL_CUBE if variant == "pick" else CUBE
        self._cubes = 0 if variant == "reach" else count
        parked = {f"object{i}:joint": [*parking_place(i, self.half), 1, 0, 0, 0] for i in range(self._cubes)}
        super().__init__(
            model_path=str(asset("push")),  # only looked for: `_initialize_simulation` builds the scene
            initial_qpos={**ROBOT_START, **parked},
            n_substeps=SUBSTEPS,
            has_object=variant != "reach",
            block_gripper=variant != "pick",
            gripper_extra_height=0.2,  # the grip starts at (1.3419, 0.7491, 0.5347)
            target_in_the_air=False,
            target_offset=0.0,
            obj_range=0.15,
            target_range=0.15,
            distance_threshold=0.05,
            reward_type="dense",
        )
        names = [f"object{i}" for i in range(self._cubes)]
        self._bodies = [self.model.body(name).id for name in names]
        self._geoms = [self.model.geom(name).id for name in names]
        self._addresses = [self.model.joint(f"{name}:joint").qposadr[0] for name in names]
        self._spheres = [self.model.site(f"sphere{i}").id for i in range(count - self._cubes)]
        self._goal_site = self.model.site("target0").id
        self._grip_site = self.model.site("robot0:grip").id
        self._fingers = [self.model.joint(f"robot0:{side}_gripper_finger_joint").qposadr[0] for side in "lr"]
        self.start_grip = self.grip

    initial_qpos: Any  # joint values by name, and, once the robot has settled, those of all joints

    def _initialize_simulation(self) -> None:
        """As in the base class, with our scene in place of a file."""
        spheres = self.count - self._cubes
        self.model = build_spec(self._cubes, spheres, pick=self.variant == "pick").compile()
        self.data = mujoco.MjData(self.model)
        self._model_names = self._utils.MujocoModelNames(self.model)
        self._env_setup(initial_qpos=self.initial_qpos)
        self.initial_time = self.data.time
        self.initial_qpos = np.copy(self.data.qpos)
        self.initial_qvel = np.copy(self.data.qvel)

    def place(self, layout: Layout) -> None:
        """Start an episode: the same state for the same layout, whatever came before."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = self.initial_time
        self.data.qpos[:], self.data.qvel[:] = self.initial_qpos, self.initial_qvel
        colours = np.ones((len(layout.places), 4))
        colours[:, :3] = layout.colours / 255.0
        for i, place in enumerate(layout.places):
            if self._cubes:
                address = self._addresses[i]
                self.data.qpos[address : address + 7] = [*place, 1, 0, 0, 0]
                self.model.geom_rgba[self._geoms[i]] = colours[i]
            else:
                self.model.site_pos[self._spheres[i]] = place
                self.model.site_rgba[self._spheres[i]] = colours[i]
        for sphere in self._spheres[len(layout.places) :]:
            self.model.site_rgba[sphere] = 0.0
        self.model.site_pos[self._goal_site] = layout.goal
        self.model.site_rgba[self._goal_site, 3] = 1.0 if self._cubes else 0.0  # Reach's goal is one of its spheres
        self.goal = layout.goal.copy()
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: npt.NDArray[np.float32]) -> None:
        """One environment step of an action (4,) in [-1, 1]."""
        self._set_action(action.astype(np.float64))
        self._mujoco_step(action)
        self._step_callback()
        if not self.block_gripper:  # else the callback did
            mujoco.mj_forward(self.model, self.data)

    @property
    def grip(self) -> Vector:
        """Point between the finger tips, (3,) metres."""
        return np.array(self.data.site_xpos[self._grip_site])

    @property
    def opening(self) -> float:
        """How far the fingers are apart beyond closed, metres: 0 to 0.1."""
        return float(sum(self.data.qpos[address] for address in self._fingers))

    def cubes(self, count: int) -> Vector:
        """Centres of the first `count` cubes, (count, 3) metres."""
        return np.array(self.data.xpos[self._bodies[:count]])
