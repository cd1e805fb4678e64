"""The scripted experts: success within 25 agent steps, cubes that stay on the table, still hands afterwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from playslot_rl.config import BlocksConfig
from playslot_rl.config.compose import compose
from playslot_rl.envs import block_config
from playslot_rl.envs.block_push import BlockEnv, BlockPickEnv, BlockPushEnv, BlockReachEnv

VARIANTS: dict[str, type[BlockEnv]] = {"push": BlockPushEnv, "reach": BlockReachEnv, "pick": BlockPickEnv}


@dataclass
class Tally:
    """Fractions of the episodes."""

    success: float
    fallen: float
    solved_at_the_end: float


def run(variant: str, episodes: int, distractors: int, noise: float = 0.0, expert: bool = True) -> Tally:
    """Play seeds 0, 1, ... without drawing."""
    env = VARIANTS[variant](block_config(f"block_{variant}", BlocksConfig(distractors=distractors)))
    env.draw_steps = env.draw_resets = False
    success = fallen = last = 0
    for seed in range(episodes):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        solved = []
        for _ in range(env.config.max_steps):
            wanted = env.expert_action() + rng.normal(0.0, noise, 4) if expert else rng.uniform(-1.0, 1.0, 4)
            solved.append(env.step(wanted)[4]["success"])
        success += any(solved)
        last += solved[-1]
        if variant != "reach":
            fallen += bool(env.scene.object[2] < 0.4)
    env.close()
    return Tally(success / episodes, fallen / episodes, last / episodes)


@pytest.mark.integration
@pytest.mark.parametrize(("variant", "distractors"), [("push", 0), ("push", 4), ("reach", 3), ("pick", 3)])
def test_experts_solve_a_few_episodes_and_leave_them_solved(variant: str, distractors: int) -> None:
    tally = run(variant, 5, distractors)
    assert tally == Tally(1.0, 0.0, 1.0)


def test_asking_the_expert_changes_nothing() -> None:
    env = BlockPushEnv()
    env.draw_steps = False
    env.reset(seed=0)
    state = env._simulation.data.qpos.copy()
    actions = [env.expert_action() for _ in range(3)]
    np.testing.assert_array_equal(env._simulation.data.qpos, state)
    np.testing.assert_array_equal(actions[0], actions[2])
    assert actions[0].dtype == np.float32
    assert np.abs(actions[0]).max() <= 1.0
    env.close()


def test_the_pusher_holds_still_when_the_cube_is_there() -> None:
    env = BlockPushEnv(replace(block_config("block_push", BlocksConfig(distractors=0)), max_steps=30))
    env.draw_steps = False
    env.reset(seed=1)
    places = []
    for _ in range(30):
        env.step(env.expert_action())
        places.append(env.scene.object)
    env.close()
    assert np.ptp(places[-8:], axis=0).max() < 0.002
    assert env.distance < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("distractors", [0, 1, 2, 3, 4])
def test_push_expert_solves_97_percent_of_200_episodes_and_knocks_no_cube_off_the_table(distractors: int) -> None:
    tally = run("push", 200, distractors)
    assert tally.success >= 0.97
    assert tally.fallen == 0.0
    assert tally.solved_at_the_end >= 0.97


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["reach", "pick"])
def test_reach_and_pick_experts_solve_97_percent_of_200_episodes(variant: str) -> None:
    assert run(variant, 200, 3).success >= 0.97


@pytest.mark.slow
def test_the_papers_preset_of_the_noise_gives_about_80_percent() -> None:
    noise = compose(["env=block_push", "preset=paper"]).collect.noise
    assert noise > 0.0
    assert 0.72 <= run("push", 200, 3, noise).success <= 0.88


@pytest.mark.slow
def test_random_actions_hardly_ever_push_the_cube_there() -> None:
    assert run("push", 100, 3, expert=False).success <= 0.12
