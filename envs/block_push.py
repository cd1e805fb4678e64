"""The blocks family: a Fetch arm that reaches for spheres, pushes cubes or picks them up.

`BlockPush` is Push with the task `odd` and three distractors. Written anew after the multi-object-fetch tasks, on
gymnasium-robotics' `MujocoFetchEnv`. The scripted experts are proportional control of the grip, a function of the
present state alone.

Shapes: A = 4, S = 4, H = W = `EnvConfig.image_size`. Lengths in metres, world coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config import BlocksConfig, EnvConfig, RenderConfig
from playslot_rl.envs import block_config
from playslot_rl.envs.block_layout import Layout, Variant, Vector, draw_layout
from playslot_rl.envs.culling import Still
from playslot_rl.envs.pixel_task import Action, PixelTask
from playslot_rl.envs.rendering import FrameRenderer, import_mujoco

SUCCESS: Final = 0.05  # distance in metres, in space, under which the task is solved
SENTENCES: Final[dict[Variant, str]] = {
    "push": "Push the {} cube onto the red sphere.",
    "reach": "Reach for the {} sphere.",
    "pick": "Lift the {} cube to the red sphere.",
}
WHICH: Final = {"red": "red", "reddest": "reddest", "odd": "odd", "odd_groups": "odd"}

# The experts' numbers.
GAIN: Final = 14.0
TRAVEL_Z: Final = 0.540  # height at which the closed gripper passes over the cubes
PUSH_Z: Final = 0.452
LOW_Z: Final = 0.480  # under it the fingers meet the cubes
BEHIND: Final = 0.115  # distance behind the cube's centre at which the gripper comes down
CLEAR: Final = 0.095
"""Least distance at which the fingers come down beside a cube, whichever way it is turned."""
LATERAL: Final = 0.03  # how far from the line through goal and cube the pusher may be
STEP: Final = 0.06
SLOW: Final = 0.7
"""Longest way ahead that the pusher aims at, and the part of the remaining way: a cube that is hit slides on."""
REST: Final = 0.02  # a cube that is being pushed is left at this distance from the goal
NEAR: Final = 0.045  # any other cube that is this near is left alone: the task is solved under 0.05
PICK_TRAVEL_Z: Final = 0.52  # height at which the open gripper passes over the small cubes
AROUND: Final = 0.02  # how near the grip is to the centre of a cube that its fingers can close on
OVER: Final = 0.012  # how far aside the open gripper may come down
GRASP: Final = 0.064  # the fingers rest on a small cube at an opening of less than this
OPEN: Final = 1.0
CLOSE: Final = -1.0
FALLEN_Z: Final = 0.38  # a cube under it has fallen off the table


@dataclass(frozen=True)
class Scene:
    """What an expert knows: grip, opening of the fingers, centres (n, 3), the task's object, goal (3,)."""

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


class BlockEnv(PixelTask):
    """One task of the blocks family; `BlockPushEnv`, `BlockReachEnv` and `BlockPickEnv` say what is to be done.

    `state_vector` is the grip's xyz and the gripper's opening, metres; an action the grip's displacement xyz in units
    of 0.05 m, and (Pick only) the gripper's effort, negative closes. The reward of an agent step is the mean of its
    environment steps' (25 Hz): dense, in (0, 1], with the distance d from the object to its goal and the distance g
    from the grip to the object, 0.9 exp(-20 d) + 0.1 exp(-10 g); for Reach, where the grip itself is the object,
    0.9 exp(-20 d) + 0.1 exp(-10 d); sparse, 0 if solved, else -1. All else is as of a `PixelTask`.

    `env` None means three distractors, `odd`, 25 agent steps of two environment steps.
    """

    variant: ClassVar[Variant]

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array"],
        "render_fps": 12,
        "control_hz": 25,
        "task": "",
        "action": "grip displacement x, y, z in units of 0.05 m and gripper effort (used by Pick only)",
    }
    """`control_hz` counts environment steps: an agent step of `frame_skip` of them takes `frame_skip / 25` seconds."""
    distance_seen = 0.7
    still = ("robot0:base_link", "robot0:torso_lift_link", "robot0:torso_fixed_link")

    layout: Layout

    @classmethod
    def metadata_of(cls, config: EnvConfig) -> dict[str, Any]:
        """Gymnasium's metadata with the sentence that says what is to be done."""
        return {**cls.metadata, "task": SENTENCES[cls.variant].format(WHICH[config.blocks.task])}

    def __init__(
        self,
        env: EnvConfig | None = None,
        render: RenderConfig | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        super().__init__(env or block_config(f"block_{self.variant}", BlocksConfig()), render_mode)
        self.metadata = self.metadata_of(self.config)
        import_mujoco()
        from playslot_rl.envs.block_simulation import CAMERA, SCREEN, STILL, BlockSimulation, lighten

        blocks = self.config.blocks
        most = blocks.distractors if blocks.distractors_to is None else blocks.distractors_to
        self._simulation = BlockSimulation(self.variant, 1 + most)
        render, model = render or RenderConfig(), self._simulation.model
        if render.quality == "fast":
            lighten(model)
        still = Still(self._simulation.data, STILL, SCREEN)
        self._make_renderer = partial(FrameRenderer, model, CAMERA, self.config.image_size, render, still=still)

    def _begin(self, rng: np.random.Generator) -> None:
        self.layout = draw_layout(rng, self.variant, self.config.blocks, self._simulation.start_grip)
        self._simulation.place(self.layout)

    def objects(self) -> tuple[tuple[str, ...], ...]:
        kind = "sphere" if self.variant == "reach" else "object"
        things = (f"{kind}{i}" for i in range(self._simulation.count))
        return ("robot0:base_link",), ("target0",), *((name,) for name in things)

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        scene = self.scene
        return {"grip": np.array(scene.grip), **{f"object{i}": np.array(p) for i, p in enumerate(scene.places)}}

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._simulation.advance(action)
        scene, d = self.scene, self.distance
        solved = d < SUCCESS
        if self.config.blocks.reward == "sparse":
            return (0.0 if solved else -1.0), solved
        g = np.linalg.norm(scene.object - scene.grip)
        return float(0.9 * np.exp(-20.0 * d) + 0.1 * np.exp(-10.0 * g)), solved

    @property
    def distance(self) -> float:
        """Metres from the object (Reach: the grip) to the goal, in space."""
        scene = self.scene
        moved = scene.grip if self.variant == "reach" else scene.object
        return float(np.linalg.norm(moved - scene.goal))

    @property
    def scene(self) -> Scene:
        simulation, layout = self._simulation, self.layout
        places = layout.places if self.variant == "reach" else simulation.cubes(len(layout.places))
        return Scene(simulation.grip, simulation.opening, places, layout.target, layout.goal)

    def _solved(self) -> bool:
        return self.distance < SUCCESS

    def _state(self) -> npt.NDArray[np.float32]:
        return np.array([*self._simulation.grip, self._simulation.opening], np.float32)

    def expert_action(self) -> Action:
        return EXPERTS[self.variant](self.scene)


class BlockPushEnv(BlockEnv):
    """Push the cube that the task means onto the red sphere. The gripper is closed and locked."""

    variant = "push"


class BlockReachEnv(BlockEnv):
    """Move the gripper to the sphere that the task means. The gripper is closed and locked."""

    variant = "reach"


class BlockPickEnv(BlockEnv):
    """Lift the cube that the task means to the red sphere in the air."""

    variant = "pick"
