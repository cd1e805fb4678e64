"""The simulation of the blocks family: gymnasium-robotics' `MujocoFetchEnv` on a scene built with `mujoco.MjSpec`.

From the Fetch assets that gymnasium-robotics ships: a Fetch arm, a light grey table, cubes with free joints or spheres
without collision, the goal (a red sphere), one directional light, a green sky, and the camera. All lengths are metres
in world coordinates; z is up. Import it after `playslot_rl.envs.rendering.import_mujoco` was called.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import farama_notifications
import mujoco
import numpy as np
import numpy.typing as npt

from playslot_rl.envs.block_layout import CUBE, SMALL_CUBE, Layout, Variant, Vector

farama_notifications.notifications.pop("gymnasium_robotics", None)  # it prints about other environments
from gymnasium_robotics.envs.fetch import fetch_env  # noqa: E402

MujocoFetchEnv: Any = fetch_env.MujocoFetchEnv
SCENES = Path(fetch_env.__file__).parents[1] / "assets" / "fetch"

CAMERA: Final = "frontview"
CAMERA_PLACE: Final = (1.9, 0.75, 0.8)
CAMERA_EULER: Final = (0.0, 1.0, 1.571)
"""Radians about x, y, z, each turning the next one's axes; a camera looks along its own -z."""
SPHERE: Final = 0.04  # radius of the goal, and of Reach's spheres
PARKING_X: Final = 4.0  # where cubes rest that the episode does not use: on the floor, behind the camera

STILL: Final = ("robot0:base_link", "robot0:torso_lift_link", "robot0:torso_fixed_link")
"""Parts of the robot that never move, mostly behind the table."""
SCREEN: Final = "table0"
UNSEEN: Final = ("estop_link", "laser_link", "head_pan_link", "head_tilt_link")
"""Meshes of many facets that the camera never sees: the same pixels without them."""
_FINGER: Final = (0.05775, 0.021, 0.02025)
_DARK_GREY: Final = (0.2, 0.2, 0.2, 1.0)
_INVISIBLE: Final = (0.0, 0.0, 0.0, 0.0)
SUBSTEPS: Final = 20  # simulation steps of 2 ms in an environment step: 25 Hz
ROBOT_START: Final = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}


def build_spec(cubes: int = 0, spheres: int = 0, pick: bool = False) -> mujoco.MjSpec:
    """The scene: cubes `object0`, ... with joints `object0:joint`, ..., all parked, and sites `sphere0`, ... without
    collision, invisible until they are coloured. To pick, the cubes are smaller and the gripper opens and closes;
    otherwise its fingers are enlarged and are meant to be locked."""
    spec = mujoco.MjSpec.from_file(str(SCENES / f"{'pick_and_place' if pick else 'push'}.xml"))
    spec.detach_body(spec.body("object0"))
    spec.detach_body(spec.body("floor0"))  # its site moves only when gymnasium-robotics renders; ours is the world's
    world = spec.worldbody
    # Not at the origin: MuJoCo would take the world's frame for theirs and ignore where they are moved to.
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [SPHERE] * 3, "pos": [0, 0, 1]}
    world.add_site(name="target0", rgba=[1, 0, 0, 1], **sphere)
    for i in range(spheres):
        world.add_site(name=f"sphere{i}", rgba=_INVISIBLE, **sphere)
    half = SMALL_CUBE if pick else CUBE
    for i in range(cubes):
        body = world.add_body(name=f"object{i}", pos=(PARKING_X, 0.25 * i, half))
        body.add_joint(name=f"object{i}:joint", type=mujoco.mjtJoint.mjJNT_FREE, damping=0.01)
        body.add_geom(
            name=f"object{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half] * 3,
            condim=3,
            mass=2.0,
            material="block_mat",
            rgba=[1, 1, 1, 1],
        )
        body.add_site(name=f"object{i}", rgba=_INVISIBLE)
    spec.body(SCREEN).geoms[0].name = SCREEN
    for geom in spec.body("robot0:mocap").geoms:
        geom.rgba = _INVISIBLE  # a marker with axes of a metre
    for side in "rl":
        finger = spec.geom(f"robot0:{side}_gripper_finger_link")
        finger.rgba = _DARK_GREY
        if not pick:
            finger.size = _FINGER
    camera = world.add_camera(name=CAMERA, pos=CAMERA_PLACE, fovy=60.0)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_EULER
    camera.alt.euler = CAMERA_EULER
    return spec


def lighten(model: mujoco.MjModel) -> None:
    """Make frames cheaper, before a renderer is made: without the unseen meshes, boxes of one quad a side.

    The unseen meshes do not change a pixel; boxes lit at four points a side instead of 25 change a few, by one level.
    """
    for name in UNSEEN:
        model.geom(f"robot0:{name}").rgba[3] = 0.0
    model.vis.quality.numquads = 1


class BlockSimulation(MujocoFetchEnv):
    """Arm, table and objects; `place` starts an episode, `advance` runs one environment step. Every episode begins with
    the grip at `start_grip`, (3,) metres."""

    def __init__(self, variant: Variant, count: int) -> None:
        self.variant, self.count = variant, count
        self._cubes = 0 if variant == "reach" else count
        super().__init__(
            model_path=str(SCENES / "push.xml"),  # only looked for: `_initialize_simulation` builds the scene
            initial_qpos=ROBOT_START,  # the cubes start where the scene parks them
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
