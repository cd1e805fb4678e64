"""OGBench's cubes (Park et al. 2025; ogbench 1.2.2, the extra `ogbench`): a UR5e arm picks them up and puts them down.

Shapes: A = 5, S = 5, n cubes, H = W = `EnvConfig.image_size`. Lengths in metres, world coordinates.
"""

from __future__ import annotations

import copy
from functools import partial
from typing import Any, Final

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.families import FAMILIES, OGBENCH, OGBENCH_GOALS
from playslot_rl.envs import family_config
from playslot_rl.envs.pixel_task import Action, PixelTask
from playslot_rl.envs.rendering import FrameRenderer, import_mujoco
from playslot_rl.errors import ConfigError

ACTIONS: Final = 5
"""Of a task's evaluation, numbered from 1."""
CAMERA: Final = "front_pixels"
DETAIL: Final = 0.005  # under software GL the gripper's finer meshes would cost three quarters of a frame
PLACED: Final = 0.04  # OGBench: how far from its target a cube counts as there
EXACT: Final = 0.02  # its oracle's
OPEN: Final = 0.1  # contact of a finger below which it takes the gripper to be open
LIFTED: Final = 0.16  # height from which it moves sideways
BESIDE: Final = 0.06  # cubes are 0.04 wide
CLEAR: Final = 0.09
SPOTS: Final = [np.array([x, y, 0.02]) for x in (0.35, 0.425, 0.5) for y in (-0.2, -0.1, 0.0, 0.1, 0.2)]
"""Where a cube that is in the way may be put."""

Vector = npt.NDArray[np.float64]
Move = tuple[int, Vector]
"""A cube's number, and where it is to be put (3,)."""


def load_cubes() -> tuple[Any, Any]:
    """OGBench's environment of cubes and their Markovian oracle; a ConfigError where it is not installed."""
    import_mujoco()
    try:
        from ogbench.manipspace.envs.cube_env import CubeEnv
        from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"env={OGBENCH}: got no package {error.name}, expected OGBench: pip install 'playslot_rl[ogbench]'"
        ) from error
    return CubeEnv, CubeMarkovOracle


def next_move(cubes: Vector, targets: Vector) -> Move | None:
    """What brings cubes (n, 3) nearer to their targets (n, 3): one whose target is free and supported, lower ones
    first; else one that is in another's way, to a free spot. None where all are there.
    """

    def in_the_way(i: int) -> list[int]:
        """Cubes on cube i, or at its target."""
        found = []
        for j in range(len(cubes)):
            at_target, on_it = targets[i] - cubes[j], cubes[j] - cubes[i]
            there = np.linalg.norm(at_target[:2]) < BESIDE and abs(at_target[2]) < BESIDE / 2
            if j != i and (there or (np.linalg.norm(on_it[:2]) < BESIDE / 2 and on_it[2] > EXACT)):
                found.append(j)
        return found

    def supported(i: int) -> bool:
        below = targets[i] - cubes - (0.0, 0.0, 2 * EXACT)
        return bool(targets[i, 2] < PLACED or (np.linalg.norm(below, axis=1) < PLACED).any())

    left = np.flatnonzero(np.linalg.norm(cubes - targets, axis=1) > PLACED)
    for i in sorted(left.tolist(), key=lambda i: float(targets[i, 2])):
        if supported(i) and not in_the_way(i):
            return i, targets[i]
    for i in left.tolist():
        for j in in_the_way(i):
            others = np.concatenate((np.delete(cubes, j, 0), targets))[:, :2]
            free = [spot for spot in SPOTS if np.linalg.norm(others - spot[:2], axis=1).min() > CLEAR]
            return j, min(free, key=lambda spot: float(np.linalg.norm(spot - cubes[j])))
    return None


class CubeTask(PixelTask):
    """The task `EnvConfig.task`: `cube-single` or `cube-double`; see `PixelTask`.

    With `env.goals=evaluation` the episode of seed s has the goal 1 + s mod 5 of OGBench's five, so that episodes of
    seeds that follow one another take them in turn. It is solved when every cube is within 0.04 m of its target, and
    the reward is the part of the agent step's environment steps (50 ms) that are. With `random`, as OGBench makes its
    data, a cube gets a new target when the oracle is done with the last one, or after 200 steps.

    `state_vector` is the hand's xyz and yaw (radians) and the gripper's closing, 0 to 1; an action the hand's
    displacement in units of 0.05 m, its turn in units of 0.3 radians, and the gripper's closing, in each environment
    step.

    The picture is that of OGBench's `visual-` environments, and with `env.targets` what it calls `visualize_info`: the
    targets are translucent cubes, and a cube is pale where it is to be.

    Note: `fast` also draws meshes without details under 5 mm, a third of what a pixel shows.
    """

    distance_seen = 0.9
    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "control_hz": 20,
        "task": "",
        "action": "hand displacement x, y, z, turn, and the gripper's closing",
    }

    @classmethod
    def actions_of(cls, config: EnvConfig) -> int:
        """Width of its actions; a ConfigError without OGBench."""
        del config
        load_cubes()
        return ACTIONS

    @classmethod
    def metadata_of(cls, config: EnvConfig) -> dict[str, Any]:
        """Gymnasium's metadata with the sentence that says what is to be done."""
        return {**cls.metadata, "task": FAMILIES[OGBENCH].tasks[config.task].sentence}

    def __init__(
        self, env: EnvConfig | None = None, render: RenderConfig | None = None, render_mode: str | None = "rgb_array"
    ) -> None:
        cube_env, oracle = load_cubes()
        config = env or family_config(OGBENCH)
        super().__init__(config, render_mode, actions=ACTIONS, state=5)
        self.metadata = self.metadata_of(config)
        # It draws each observation, and its goals are shaken by actions of a box that nobody seeds.
        base = type("Cubes", (cube_env,), {"action_space": None, "compute_observation": lambda _: None})
        self._drawn = config.goals == "random"
        mode = "data_collection" if self._drawn else "task"
        kind = config.task.removeprefix("cube-")
        self._simulation = base(kind, ob_type="pixels", mode=mode, visualize_info=config.targets)
        self._simulation.action_space = gym.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
        self._oracle = oracle(env=self._simulation)
        self._begin(np.random.default_rng(0))  # it makes MuJoCo's model
        cutoff = self._simulation.model.light_cutoff
        cutoff[cutoff > 90.0] = 180.0  # a spotlight's 100 degrees are none that OpenGL takes: it keeps 180
        self._make_renderer = partial(
            FrameRenderer, self._simulation.model, CAMERA, config.image_size, render or RenderConfig(), cell=DETAIL
        )

    def _begin(self, rng: np.random.Generator) -> None:
        env = self._simulation
        env.np_random = rng
        self._move: Move | None = None
        env.action_space.seed(int(rng.integers(2**31)))
        _, info = env.reset(options={"task_id": 1 + self.episode % OGBENCH_GOALS})
        self._stacks = rng.uniform(0.0, 0.25)  # OGBench's data of two cubes; one is never put on another
        self._start_oracle()
        self._look(info)

    def _start_oracle(self) -> None:
        """Its own `reset` draws from numpy's global generator."""
        oracle, env = self._oracle, self._simulation
        oracle._done, oracle._step = False, 0
        oracle._final_pos = env.np_random.uniform(*env._arm_sampling_bounds)
        oracle._final_yaw = env.np_random.uniform(-np.pi, np.pi)

    def _look(self, info: dict[str, Any], tried: bool = False) -> None:
        """Note what OGBench says of the present state, and what its oracle does now."""
        self._info = info
        if not self._drawn:
            self._move = cube, target = self._moved(info)
            told = {"block": cube, "block_pos": target, "block_yaw": np.zeros(1)}
            info.update({f"privileged/target_{name}": value for name, value in told.items()})
        self._action = np.asarray(self._oracle.select_action(None, info), np.float32)
        if self._drawn and self._oracle._done and not tried:
            self._start_oracle()
            self._look(self._simulation.set_new_target(p_stack=self._stacks)[1])

    def _moved(self, info: dict[str, Any]) -> Move:
        """The oracle's move, which it ends before it begins another."""
        cubes, targets = self._cubes(), self._targets()
        if self._move is not None:
            cube, target = self._move
            let_go = info["proprio/gripper_contact"][0] < OPEN and info["proprio/effector_pos"][2] > LIFTED
            if not let_go or np.linalg.norm(cubes[cube] - target) > EXACT:
                return self._move
        return next_move(cubes, targets) or self._move or (0, targets[0])

    def _cubes(self) -> Vector:
        env = self._simulation
        return np.stack([env.data.joint(f"object_joint_{i}").qpos[:3] for i in range(env._num_cubes)])

    def _targets(self) -> Vector:
        found: Vector = self._simulation.data.mocap_pos[self._simulation._cube_target_mocap_ids].copy()
        return found

    def _advance(self, action: Action) -> tuple[float, bool]:
        _, reward, _, _, info = self._simulation.step(action)
        self._look(info)
        return float(reward), bool(info["success"])

    def _solved(self) -> bool:
        there = self._simulation._compute_successes()
        return bool(there[self._simulation._target_block] if self._drawn else all(there))

    def _state(self) -> npt.NDArray[np.float32]:
        parts = ("effector_pos", "effector_yaw", "gripper_opening")
        row: npt.NDArray[np.float64] = np.concatenate([self._info[f"proprio/{part}"] for part in parts])
        return row.astype(np.float32)

    def expert_action(self) -> Action:
        """What OGBench's Markovian oracle, who chooses anew at each environment step, does on average in the next agent
        step: its steps are tried on a copy of the simulation.

        Note: the oracle moves one cube; which, and where to, says `next_move`.
        """
        env, own = self._simulation, dict(self.__dict__)
        kept, oracle = dict(env.__dict__), dict(self._oracle.__dict__)
        env._data, actions = copy.copy(env._data), [self._action]
        try:
            for _ in range(self.config.frame_skip - 1):
                self._look(env.step(actions[-1])[4], tried=True)
                actions.append(self._action)
        finally:
            for holder, before in ((env, kept), (self._oracle, oracle), (self, own)):
                holder.__dict__.clear()
                holder.__dict__.update(before)
            env.post_step()  # it colours the model's cubes
        mean: Action = np.mean(actions, axis=0).astype(np.float32)
        return mean

    def objects(self) -> tuple[tuple[str, ...], ...]:
        count, shown = self._simulation._num_cubes, self.config.targets
        cubes = [f"object_{i}" for i in range(count)] + [f"object_target_{i}" for i in range(count if shown else 0)]
        return (self._arm,), *((name,) for name in cubes)

    @property
    def _arm(self) -> str:
        model = self._simulation.model
        return str(model.body(model.body_rootid[model.body("ur5e/base").id]).name)

    def places(self) -> dict[str, npt.NDArray[np.float64]]:
        cubes = {f"cube{i}": place for i, place in enumerate(self._cubes())}
        return {"hand": self._info["proprio/effector_pos"].copy(), **cubes}
