"""The blocks family as Gymnasium and TorchRL environments: episodes, rewards, frames, and what they refuse."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config import BlocksConfig, EnvConfig, RenderConfig
from playslot_rl.config.compose import compose
from playslot_rl.envs import EASY, ENVIRONMENTS, block_config, block_ids, make_env
from playslot_rl.envs.block_push import BlockEnv, BlockPickEnv, BlockPushEnv, BlockReachEnv
from playslot_rl.errors import ConfigError

NAMES = ("block_push", "block_push_easy", "block_reach", "block_pick")


@pytest.fixture(scope="module")
def push() -> Iterator[BlockPushEnv]:
    made = BlockPushEnv()
    yield made
    made.close()


@pytest.fixture(scope="module")
def ranged() -> Iterator[BlockPushEnv]:
    made = BlockPushEnv(block_config("block_push", BlocksConfig(distractors=0, distractors_to=4)))
    yield made
    made.close()


def episode(env: BlockEnv, seed: int, steps: int = 4) -> tuple[np.ndarray, np.ndarray]:
    first = env.reset(seed=seed)[0]
    seen = [first, *(env.step(env.expert_action())[0] for _ in range(steps))]
    return np.stack([o["pixels"] for o in seen]), np.stack([o[keys.STATE] for o in seen])


@pytest.mark.integration
def test_same_seed_repeats_the_same_episode_whatever_came_before(ranged: BlockPushEnv) -> None:
    frames, states = episode(ranged, 5)
    counts = set()
    for seed in range(6, 14):
        ranged.reset(seed=seed)
        counts.add(len(ranged.layout.places))
    episode(ranged, 6, 8)
    assert len(counts) > 2
    again = episode(ranged, 5)
    np.testing.assert_array_equal(again[0], frames)
    np.testing.assert_array_equal(again[1], states)
    other = BlockPushEnv(ranged.config)
    np.testing.assert_array_equal(episode(other, 5)[0], frames)
    other.close()


def test_the_grip_starts_at_the_references_place_and_cubes_stand_where_they_were_put(push: BlockPushEnv) -> None:
    for seed in range(5):
        observation, info = push.reset(seed=seed)
        np.testing.assert_allclose(observation[keys.STATE][:3], (1.3419, 0.7491, 0.5348), atol=2e-4)
        assert 0.0 <= observation[keys.STATE][3] < 1e-3
        np.testing.assert_allclose(push.scene.places, push.layout.places, atol=1e-9)
        assert info == {"success": False}
        for _ in range(3):
            push.step(np.zeros(4, np.float32))
        np.testing.assert_allclose(push.scene.places, push.layout.places, atol=2e-3)  # nothing was stacked or falls


def test_cubes_that_an_episode_does_not_use_stand_out_of_the_way(ranged: BlockPushEnv) -> None:
    seed = next(s for s in range(50) if ranged.reset(seed=s) and len(ranged.layout.places) == 1)
    ranged.reset(seed=seed)
    for _ in range(5):
        ranged.step(ranged.expert_action())
    others = ranged._simulation.cubes(5)[1:]
    assert (others[:, 0] > 3.5).all()
    assert np.abs(others[:, 2] - 0.045).max() < 0.002


@pytest.mark.integration
def test_dense_and_sparse_rewards_are_the_formulas(push: BlockPushEnv) -> None:
    single = BlockPushEnv(replace(push.config, frame_skip=1))
    sparse = BlockPushEnv(replace(push.config, frame_skip=1, blocks=BlocksConfig(reward="sparse")))
    single.draw_steps = sparse.draw_steps = False
    rewards = []
    for env in (single, sparse):
        env.reset(seed=3)
    for _ in range(40):
        action = single.expert_action()
        _, dense, *_ = single.step(action)
        _, reward, *_, info = sparse.step(action)
        goal, grip, cube = single.scene.goal, single.scene.grip, single.scene.object
        d, g = np.linalg.norm(cube - goal), np.linalg.norm(cube - grip)
        assert dense == pytest.approx(0.9 * np.exp(-20 * d) + 0.1 * np.exp(-10 * g))
        assert reward == (0.0 if info["success"] else -1.0)
        assert info["success"] == (d < 0.05)
        rewards.append(reward)
    assert set(rewards) == {0.0, -1.0}
    single.close()
    sparse.close()


def test_an_agent_step_is_the_mean_of_its_environment_steps_and_solved_if_one_is(push: BlockPushEnv) -> None:
    single = BlockPushEnv(replace(push.config, frame_skip=1))
    single.draw_steps = push.draw_steps = False
    push.reset(seed=4)
    single.reset(seed=4)
    for _ in range(12):
        action = push.expert_action()
        _, reward, _, _, info = push.step(action)
        parts = [single.step(action) for _ in range(2)]
        assert reward == pytest.approx(np.mean([p[1] for p in parts]))
        assert info["success"] == any(p[4]["success"] for p in parts)
    push.draw_steps = True
    single.close()


def test_an_episode_goes_on_past_success_to_its_fixed_length(push: BlockPushEnv) -> None:
    push.draw_steps = False
    push.reset(seed=2)
    ends = []
    solved = []
    for _ in range(25):
        *_, terminated, truncated, info = push.step(push.expert_action())
        ends.append((terminated, truncated))
        solved.append(info["success"])
    push.draw_steps = True
    assert ends == [(False, False)] * 24 + [(False, True)]
    first = solved.index(True)
    assert all(solved[first:])
    assert first < 20


def near(frame: np.ndarray, rgb: tuple[int, int, int], tolerance: float) -> int:
    """Pixels whose direction in colour space is that of `rgb`: shading changes the length only."""
    pixels = frame.reshape(-1, 3).astype(float) + 1e-6
    wanted = np.array(rgb, float)
    cosine = pixels @ wanted / np.linalg.norm(pixels, axis=1) / np.linalg.norm(wanted)
    return int((cosine > np.cos(tolerance)).sum())


def test_the_picture_shows_cube_goal_gripper_table_and_sky() -> None:
    env = BlockPushEnv(block_config("block_push_easy", EASY))
    seen = []
    for seed in range(6):
        frame = env.reset(seed=seed)[0]["pixels"]
        assert frame.shape == (64, 64, 3)
        assert frame.dtype == np.uint8
        table, sky = frame[40:47, 10:54], frame[2, 2].astype(int)
        assert np.median(table) > 200
        assert sky[1] > sky[0] + 60
        seen.append((near(frame, (0, 0, 205), 0.15), near(frame, (255, 0, 0), 0.15)))
    env.close()
    assert min(cube for cube, _ in seen) > 10
    assert sum(goal > 5 for _, goal in seen) >= 5  # the arm or a cube may stand before it


def test_the_goal_moves_with_the_episode_and_not_only_when_drawn(push: BlockPushEnv) -> None:
    push.draw_resets = False
    places = []
    for seed in range(4):
        push.reset(seed=seed)
        site = push._simulation.data.site_xpos[push._simulation._goal_site]
        np.testing.assert_allclose(site, push.layout.goal)
        places.append(site.copy())
    push.draw_resets = True
    assert np.ptp(places, axis=0)[:2].min() > 0.01


@pytest.mark.integration
def test_frames_are_the_same_without_what_the_camera_never_sees(
    push: BlockPushEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    import contextlib

    from playslot_rl.envs import rendering
    from playslot_rl.envs.culling import FrustumCuller

    monkeypatch.setattr(rendering, "only_in_sight", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(FrustumCuller, "hide", lambda self, data: None)
    monkeypatch.setattr("playslot_rl.envs.block_simulation.UNSEEN", ())
    plain = BlockPushEnv()
    monkeypatch.undo()
    hide = FrustumCuller.hide
    for seed in range(3):
        with monkeypatch.context() as patch:
            patch.setattr(FrustumCuller, "hide", lambda self, data: None)
            plain.reset(seed=seed)
        push.reset(seed=seed)
        for action in np.random.default_rng(seed).uniform(-1, 1, (5, 4)).astype(np.float32):
            lean = push.step(action)[0]["pixels"]
            with monkeypatch.context() as patch:
                patch.setattr(FrustumCuller, "hide", lambda self, data: None)
                np.testing.assert_array_equal(plain.step(action)[0]["pixels"], lean)
    assert FrustumCuller.hide is hide
    assert push._renderer._culler is not None
    assert push._renderer._culler.unseen(push._simulation.data).any()
    plain.close()


def test_drawing_leaves_the_model_as_it_was(push: BlockPushEnv) -> None:
    from playslot_rl.envs.block_simulation import BlockSimulation

    fresh = BlockSimulation("push", 4).model
    np.testing.assert_array_equal(push._simulation.model.mesh_face, fresh.mesh_face)
    np.testing.assert_array_equal(push._simulation.model.mesh_facenum, fresh.mesh_facenum)


@pytest.mark.integration
def test_fast_rendering_looks_like_full_quality(push: BlockPushEnv) -> None:
    full = BlockPushEnv(push.config, RenderConfig(quality="full"))
    a, b = (env.reset(seed=2)[0]["pixels"].astype(float) for env in (push, full))
    full.close()
    assert 0.0 < np.abs(a - b).mean() < 3.0


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_passes_gymnasiums_checker(name: str) -> None:
    from gymnasium.utils.env_checker import check_env

    made = make_env(replace(compose([f"env={name}"]).env, image_size=32, max_steps=3))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(infinity|spec).*")
        check_env(made.unwrapped)
    made.close()


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_specs_match_what_it_returns(name: str) -> None:
    from torchrl.envs.utils import check_env_specs

    from playslot_rl.envs import make_torchrl_env

    env = make_torchrl_env(replace(compose([f"env={name}"]).env, image_size=32, max_steps=3))
    check_env_specs(env)
    assert env.rollout(10).batch_size == (3,)
    env.close()


@pytest.mark.integration
def test_every_id_starts_from_the_task_it_names() -> None:
    import gymnasium

    from playslot_rl.envs import register

    register()
    assert len(block_ids()) == 16
    assert {gym_id for name, (gym_id, _) in ENVIRONMENTS.items() if name in NAMES} <= set(block_ids())
    for gym_id, (_, config) in block_ids().items():
        assert gymnasium.spec(gym_id).kwargs == {"env": config}
    assert block_ids()["PlaySlot/BlockPush-v0"][1] == compose(["env=block_push"]).env
    assert block_ids()["PlaySlot/BlockPushEasy-v0"][1] == compose(["env=block_push_easy"]).env
    made = gymnasium.make("playslot_rl.envs:PlaySlot/BlockReachReddest-v0")
    assert isinstance(made.unwrapped, BlockReachEnv)
    assert made.unwrapped.config.blocks.task == "reddest"
    assert made.unwrapped.metadata["task"] == "Reach for the reddest sphere."
    made.close()


def test_warm_up_steps_move_the_arm_before_the_first_frame() -> None:
    env = BlockPickEnv(replace(block_config("block_pick", BlocksConfig()), warmup_steps=3))
    env.draw_resets = env.draw_steps = False
    starts = [env.reset(seed=s)[0][keys.STATE][:3] for s in range(3)]
    assert np.ptp(starts, axis=0).max() > 0.02
    env.close()


@pytest.mark.parametrize("action", [np.zeros(3), np.array([0, 0, np.inf, 0])])
def test_bad_actions_are_refused(push: BlockPushEnv, action: np.ndarray) -> None:
    push.reset(seed=0)
    with pytest.raises(ValueError, match="expected 4 finite numbers"):
        push.step(action)


def test_wrong_action_width_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"env\.action_dim: got 7"):
        BlockPushEnv(EnvConfig("block_push", action_dim=7))


def test_settings_of_the_blocks_are_refused_elsewhere() -> None:
    with pytest.raises(ConfigError, match=r"env\.blocks: got .*, expected no changes with env.name=button_press"):
        compose(["env=button_press", "env.blocks.distractors=1"])
