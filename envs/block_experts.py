"""The experts of the blocks family: proportional control of the grip, a function of the present state alone.

Push is one smooth field of motions and no list of phases. With the line from the cube's centre c through the goal g,
its direction u, the distance d = |g - c|, and the grip at c + a u + n (a ahead, n to the side) at height z,

    behind(a, n, z) = (1 - S(|n|)) S(-a)               1 in the corridor behind the cube, 0 outside
    z*  = TRAVEL_Z - (TRAVEL_Z - PUSH_Z) behind        down in it, up and over the cubes outside
    xy* = S(z) (c - BEHIND u - xy) + (1 - S(z)) behind (forward u - n)

and all of it times S(d), which comes to rest at the goal; S rises smoothly from 0 to 1 between two numbers.

Note: an expert of phases, each begun at a threshold, solves as many episodes and is hard to clone: where state is seen
2 cm wrongly, two pixels of 64, the mean of its actions solves none, that of this one nearly all (docs/environments.md).

Lengths in metres, world coordinates; n objects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from playslot_rl.envs.block_layout import Variant, Vector
from playslot_rl.envs.pixel_task import Action

GAIN: Final = 12.0
"""Action for each metre to go, of 0.05 m an environment step: a little more than the grip's lag takes away."""
LIFT_GAIN: Final = 11.0
TRAVEL_Z: Final = 0.550
"""Height at which the closed gripper passes over the cubes."""
PUSH_Z: Final = 0.452
BEHIND: Final = 0.135
"""Distance behind the cube's centre at which the gripper comes down."""
ASIDE: Final = (0.035, 0.095)
"""The corridor's half width: at the first distance to the side it begins to end, at the second it has."""
AHEAD: Final = (0.024, 0.056)
"""Distance behind the cube's centre from which on the corridor begins, and is whole, for a low grip."""
CLEAR: Final = 0.055
"""By so much farther back it begins for a high one, whose fingers are to miss the cube when it comes down."""
LOW_Z: Final = (0.485, 0.545)
"""Heights between which a grip counts as low, and as high, for where the corridor begins."""
FREE_Z: Final = (0.490, 0.540)
"""Heights between which the fingers become free of the cubes, and may go where they like."""
STEP: Final = 0.065
SLOW: Final = 0.8
"""Longest way ahead that the pusher aims at, and the part of the remaining way: a cube that is hit slides on."""
SHORT: Final = 0.01
"""The remaining way counts to this distance before the goal."""
STRAIGHT: Final = 0.7
"""Part of the corridor's half width in which the pusher goes ahead; farther aside it first comes back to the line."""
REST: Final = (0.030, 0.050)
"""Distances of cube and goal at which a grip in the corridor holds still, and is yet to slow down."""
LEAVE: Final = 0.008
"""By so much more for a grip outside it: the task is solved under 0.05."""
FALLEN_Z: Final = 0.38
"""A cube under it has fallen off the table."""
PICK_TRAVEL_Z: Final = 0.52
"""Height at which the open gripper passes over the small cubes."""
AROUND: Final = 0.02
"""How near the grip is to the centre of a cube that its fingers can close on."""
OVER: Final = 0.012
"""How far aside the open gripper may come down."""
GRASP: Final = 0.064
"""The fingers rest on a small cube at an opening of less than this."""
POINT_GAIN: Final = 14.0
"""The same as GAIN for Reach and Pick."""
OPEN: Final = 1.0
CLOSE: Final = -1.0


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


def rise(x: float, low: float, high: float) -> float:
    """S: smoothly from 0, up to `low`, to 1, from `high` on."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


def towards(scene: Scene, point: Vector, effort: float = 0.0) -> Action:
    """Move the grip to a point: float32 (4,) in [-1, 1]."""
    error = POINT_GAIN * (np.asarray(point) - scene.grip)
    return np.clip([*error, effort], -1.0, 1.0).astype(np.float32)


def reach(scene: Scene) -> Action:
    """Go to the sphere and stay."""
    return towards(scene, scene.goal)


def push(scene: Scene) -> Action:
    """Pass over the cubes to behind the cube, come down, push along the line to the goal, and hold still."""
    cube, grip = scene.object[:2], scene.grip
    way = scene.goal[:2] - cube
    d = float(np.linalg.norm(way))
    u = way / max(d, 1e-6)
    a = float((grip[:2] - cube) @ u)
    aside = grip[:2] - cube - a * u
    n, back = float(np.linalg.norm(aside)), CLEAR * rise(grip[2], *LOW_Z)
    behind = (1 - rise(n, *ASIDE)) * rise(-a, AHEAD[0] + back, AHEAD[1] + back)
    forward = min(STEP, SLOW * max(d - SHORT, 0.0)) * (1 - rise(n, STRAIGHT * ASIDE[0], STRAIGHT * ASIDE[1]))
    free, leave = rise(grip[2], *FREE_Z), LEAVE * (1 - behind)
    move = free * (cube - BEHIND * u - grip[:2]) + (1 - free) * behind * (forward * u - aside)
    lift = TRAVEL_Z - (TRAVEL_Z - PUSH_Z) * behind - grip[2]
    moving = rise(d, REST[0] + leave, REST[1] + leave) * (scene.object[2] >= FALLEN_Z)
    return np.clip([*(moving * GAIN * move), moving * LIFT_GAIN * lift, 0.0], -1.0, 1.0).astype(np.float32)


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
