"""The scene of the blocks family, built with `mujoco.MjSpec` from the Fetch assets that gymnasium-robotics ships.

A Fetch arm, a light grey table, cubes with free joints or spheres without collision, the goal (a red sphere), one
directional light, a green sky, and the camera. All lengths are metres in world coordinates; z is up.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from playslot_rl.envs.rendering import FixedCamera, import_mujoco

if TYPE_CHECKING:
    import mujoco

CAMERA: Final = FixedCamera("frontview", position=(1.9, 0.75, 0.8), euler=(0.0, 1.0, 1.571), fovy=60.0)
TABLE_TOP: Final = 0.4
CUBE: Final = 0.045
"""Half the side of the cubes of Reach and Push."""
SMALL_CUBE: Final = 0.03
"""Half the side of Pick's cubes. Note: the gripper opens 0.10 m, which leaves no play round a cube of 0.09 m."""
SPHERE: Final = 0.04
"""Radius of the goal, and of Reach's spheres."""
PARKING_X: Final = 4.0
"""Where cubes rest that the episode does not use: on the floor, behind the camera."""

STILL: Final = ("robot0:base_link", "robot0:torso_lift_link", "robot0:torso_fixed_link")
"""Parts of the robot that never move, mostly behind the table."""
SCREEN: Final = "table0"
UNSEEN: Final = ("estop_link", "laser_link", "head_pan_link", "head_tilt_link")
"""Meshes of many facets that the camera never sees: the same pixels without them."""
_FINGER: Final = (0.05775, 0.021, 0.02025)
_DARK_GREY: Final = (0.2, 0.2, 0.2, 1.0)
_INVISIBLE: Final = (0.0, 0.0, 0.0, 0.0)


def import_fetch() -> Any:
    """Import gymnasium-robotics' Fetch module without the notice it prints about other environments."""
    import farama_notifications

    import_mujoco()
    farama_notifications.notifications.pop("gymnasium_robotics", None)
    from gymnasium_robotics.envs.fetch import fetch_env

    return fetch_env


def asset(name: str) -> Path:
    """A scene that gymnasium-robotics ships, such as `push`."""
    return Path(import_fetch().__file__).parents[1] / "assets" / "fetch" / f"{name}.xml"


def build_spec(cubes: int = 0, spheres: int = 0, pick: bool = False) -> mujoco.MjSpec:
    """The scene.

    Args:
        cubes: cubes `object0`, `object1`, ... with joints `object0:joint`, ..., all parked.
        spheres: sites `sphere0`, ... without collision, invisible until they are coloured.
        pick: smaller cubes, and a gripper that opens and closes; otherwise its fingers are enlarged and are meant to be
            locked.
    """
    mj = import_mujoco()
    spec = mj.MjSpec.from_file(str(asset("pick_and_place" if pick else "push")))
    spec.detach_body(spec.body("object0"))
    spec.detach_body(spec.body("floor0"))  # its site moves only when gymnasium-robotics renders; ours is the world's
    world = spec.worldbody
    # Not at the origin: MuJoCo would take the world's frame for theirs and ignore where they are moved to.
    sphere = {"type": mj.mjtGeom.mjGEOM_SPHERE, "size": [SPHERE] * 3, "pos": [0, 0, 1]}
    world.add_site(name="target0", rgba=[1, 0, 0, 1], **sphere)
    for i in range(spheres):
        world.add_site(name=f"sphere{i}", rgba=_INVISIBLE, **sphere)
    for i in range(cubes):
        _add_cube(mj, world, i, SMALL_CUBE if pick else CUBE)
    spec.body(SCREEN).geoms[0].name = SCREEN
    for geom in spec.body("robot0:mocap").geoms:
        geom.rgba = _INVISIBLE  # a marker with axes of a metre
    for side in "rl":
        finger = spec.geom(f"robot0:{side}_gripper_finger_link")
        finger.rgba = _DARK_GREY
        if not pick:
            finger.size = _FINGER
    camera = world.add_camera(name=CAMERA.name, pos=CAMERA.position, fovy=CAMERA.fovy)
    camera.alt.type = mj.mjtOrientation.mjORIENTATION_EULER
    camera.alt.euler = CAMERA.euler
    return spec


def lighten(model: mujoco.MjModel) -> None:
    """Make frames cheaper, before a renderer is made: without the unseen meshes, boxes of one quad a side.

    The unseen meshes do not change a pixel; boxes lit at four points a side instead of 25 change a few, by one level.
    """
    for name in UNSEEN:
        model.geom(f"robot0:{name}").rgba[3] = 0.0
    model.vis.quality.numquads = 1


def parking_place(index: int, half: float) -> tuple[float, float, float]:
    """Where cube `index` with half the side `half` is parked."""
    return PARKING_X, 0.25 * index, half


def _add_cube(mj: Any, world: Any, index: int, half: float) -> None:
    body = world.add_body(name=f"object{index}", pos=parking_place(index, half))
    body.add_joint(name=f"object{index}:joint", type=mj.mjtJoint.mjJNT_FREE, damping=0.01)
    body.add_geom(
        name=f"object{index}",
        type=mj.mjtGeom.mjGEOM_BOX,
        size=[half] * 3,
        condim=3,
        mass=2.0,
        material="block_mat",
        rgba=[1, 1, 1, 1],
    )
    body.add_site(name=f"object{index}", rgba=_INVISIBLE)
