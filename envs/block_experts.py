"""Scripted experts of the blocks family: proportional control of the grip, a function of the present state alone.

Lengths in metres, world coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from playslot_rl.envs.block_layout import Variant

Vector = npt.NDArray[np.float64]
Action = npt.NDArray[np.float32]

GAIN: Final = 14.0
TRAVEL_Z: Final = 0.540
"""Height at which the closed gripper passes over the cubes."""
PUSH_Z: Final = 0.452
LOW_Z: Final = 0.480
"""Under it the fingers meet the cubes."""
BEHIND: Final = 0.115
"""Distance behind the cube's centre at which the gripper comes down."""
CLEAR: Final = 0.095
"""Least distance at which the fingers come down beside a cube, whichever way it is turned."""
LATERAL: Final = 0.03
"""How far from the line through goal and cube the pusher may be."""
STEP: Final = 0.06
SLOW: Final = 0.7
"""Longest way ahead that the pusher aims at, and the part of the remaining way: a cube that is hit slides on."""
REST: Final = 0.02
"""A cube that is being pushed is left at this distance from the goal."""
NEAR: Final = 0.045
"""Any other cube that is this near is left alone: the task is solved under 0.05."""
PICK_TRAVEL_Z: Final = 0.52
"""Height at which the open gripper passes over the small cubes."""
AROUND: Final = 0.02
"""How near the grip is to the centre of a cube that its fingers can close on."""
OVER: Final = 0.012
"""How far aside the open gripper may come down."""
GRASP: Final = 0.064
"""The fingers rest on a small cube at an opening of less than this."""
OPEN: Final = 1.0
CLOSE: Final = -1.0
FALLEN_Z: Final = 0.38
"""A cube under it has fallen off the table."""


@dataclass(frozen=True)
class Scene:
    """What an expert knows.

    Attributes:
        grip: (3,).
        opening: distance between the fingers beyond closed.
        places: (n, 3) centres of the objects.
        target: index of the object the task is about.
        goal: (3,).
    """

    grip: Vector
    opening: float
    places: Vector
    target: int
    goal: Vector

    @property
    def object(self) -> Vector:
        """Centre of the object the task is about, (3,)."""
        place: Vector = self.places[self.target]
        return place


def towards(scene: Scene, point: Vector, effort: float = 0.0) -> Action:
    """Move the grip to a point: float32 (4,) in [-1, 1]."""
    error = GAIN * (np.asarray(point) - scene.grip)
    return np.clip([*error, effort], -1.0, 1.0).astype(np.float32)


def reach(scene: Scene) -> Action:
    """Go to the sphere and stay."""
    return towards(scene, scene.goal)


def push(scene: Scene) -> Action:
    """Pass over the cubes to behind the cube, come down, push along the line to the goal, and then hold still."""
    cube, goal, grip = scene.object[:2], scene.goal[:2], scene.grip
    distance = float(np.linalg.norm(goal - cube))
    along = (goal - cube) / distance
    offset = grip[:2] - cube
    ahead = float(offset @ along)
    lateral = offset - ahead * along
    behind = cube - BEHIND * along
    ready = ahead < -0.04 and np.linalg.norm(lateral) < LATERAL
    pushing = grip[2] < LOW_Z and ready
    if distance < (REST if pushing else NEAR) or scene.object[2] < FALLEN_Z:
        return towards(scene, grip)
    if pushing:
        target = grip[:2] - lateral + min(STEP, SLOW * (distance - REST)) * along
        return towards(scene, np.array([*target, PUSH_Z]))
    if np.linalg.norm(grip[:2] - behind) < LATERAL and ahead < -CLEAR:
        return towards(scene, np.array([*behind, PUSH_Z]))
    if grip[2] < TRAVEL_Z - 0.015:
        return towards(scene, np.array([*grip[:2], TRAVEL_Z + 0.02]))
    return towards(scene, np.array([*behind, TRAVEL_Z]))


def pick(scene: Scene) -> Action:
    """Open over the cube, come down round it, close, carry it to the goal, and hold it there."""
    cube, grip = scene.object, scene.grip
    aside, above = float(np.linalg.norm(grip[:2] - cube[:2])), abs(float(grip[2] - cube[2]))
    if aside < AROUND and above < AROUND:
        if scene.opening < GRASP:
            return towards(scene, grip + scene.goal - cube, CLOSE)
        return towards(scene, cube, CLOSE)
    if aside < OVER:
        return towards(scene, cube, OPEN)
    return towards(scene, np.array([*cube[:2], max(PICK_TRAVEL_Z, grip[2] - 0.02)]), OPEN)


EXPERTS: Final[dict[Variant, Callable[[Scene], Action]]] = {"push": push, "reach": reach, "pick": pick}
