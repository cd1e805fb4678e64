"""ButtonPress: its episodes, its success, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.envs import make_env, task_env
from playslot_rl.envs.metaworld import MetaWorldEnv
from playslot_rl.errors import ConfigError


@pytest.fixture(scope="module")
def env() -> Iterator[MetaWorldEnv]:
    made = make_env().unwrapped
    assert isinstance(made, MetaWorldEnv)
    yield made
    made.close()


def episode(env: MetaWorldEnv, seed: int, steps: int = 4) -> np.ndarray:
    frames = [env.reset(seed=seed)[0]["pixels"]]
    frames += [env.step(env.expert_action())[0]["pixels"] for _ in range(steps)]
    return np.stack(frames)


def test_same_seed_repeats_the_same_frames_whatever_came_before(env: MetaWorldEnv) -> None:
    first = episode(env, 5)
    episode(env, 6)
    np.testing.assert_array_equal(episode(env, 5), first)


def test_seeds_move_the_button_and_the_arm(env: MetaWorldEnv) -> None:
    boxes, hands = [], []
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        boxes.append(env._simulation.model.body("box").pos.copy())
        hands.append(observation[keys.STATE][:3])
    assert np.ptp(np.stack(boxes)[:, 0]) > 0.01
    assert np.ptp(np.stack(hands), axis=0).max() > 0.005


@pytest.mark.integration
def test_warm_up_is_independent_of_the_buttons_place(env: MetaWorldEnv) -> None:
    # The two streams of an episode must not share their numbers.
    places, hands = [], []
    for seed in range(24):
        observation, _ = env.reset(seed=seed)
        places.append(env._simulation.model.body("box").pos[0])
        hands.append(observation[keys.STATE][0])
    assert abs(np.corrcoef(places, hands)[0, 1]) < 0.6


def test_expert_presses_the_button_and_the_clip_goes_on(env: MetaWorldEnv) -> None:
    env.reset(seed=11)
    solved, ended = [], []
    for _ in range(env.config.max_steps):
        _, reward, terminated, truncated, info = env.step(env.expert_action())
        assert 0.0 <= reward <= 10.0
        solved.append(info["success"])
        ended.append(terminated or truncated)
    assert any(solved)
    assert not solved[0]
    assert ended == [False] * (env.config.max_steps - 1) + [True]


@pytest.mark.integration
def test_passes_gymnasiums_checker() -> None:
    import warnings

    from gymnasium.utils.env_checker import check_env

    made = make_env(EnvConfig(image_size=32, warmup_steps=1, max_steps=3))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(infinity|spec).*")
        check_env(made.unwrapped)
    made.close()


@pytest.mark.integration
def test_registered_id_makes_the_same_environment(env: MetaWorldEnv) -> None:
    import gymnasium

    made = gymnasium.make("playslot_rl.envs:PlaySlot/ButtonPress-v0")
    np.testing.assert_array_equal(made.reset(seed=5)[0]["pixels"], env.reset(seed=5)[0]["pixels"])
    assert task_env(made).expert_action().shape == (4,)
    made.close()


@pytest.mark.parametrize("action", [np.zeros(3), np.array([0, 0, np.nan, 0])])
def test_bad_actions_are_refused(env: MetaWorldEnv, action: np.ndarray) -> None:
    env.reset(seed=0)
    with pytest.raises(ValueError, match="expected 4 finite numbers"):
        env.step(action)


def test_unknown_environment_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean env=button_press"):
        make_env(EnvConfig(name="buton_press"))


def test_wrong_action_width_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"env\.action_dim: got 7"):
        make_env(EnvConfig(action_dim=7))


@pytest.mark.integration
def test_fast_rendering_looks_like_full_quality(env: MetaWorldEnv) -> None:
    full = make_env(EnvConfig(), RenderConfig(quality="full"))
    a = env.reset(seed=2)[0]["pixels"].astype(float)
    b = full.reset(seed=2)[0]["pixels"].astype(float)
    full.close()
    assert a.shape == b.shape == (64, 64, 3)
    assert 0.0 < np.abs(a - b).mean() < 20.0


@pytest.mark.parametrize("factor", [1, 2, 3, 8])
def test_boxes_are_averaged_exactly(factor: int) -> None:
    from playslot_rl.envs.rendering import box_mean

    frame = np.random.default_rng(0).integers(0, 256, (8 * factor, 4 * factor, 3), dtype=np.uint8)
    exact = frame.reshape(8, factor, 4, factor, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_array_equal(box_mean(frame, factor), np.floor(exact + 0.5))
    np.testing.assert_array_equal(box_mean(np.full_like(frame, 255), factor), 255)


def run_python(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    import os

    variables = {**os.environ, **variables}
    return subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, timeout=120)


@pytest.mark.integration
def test_unclosed_environments_leave_no_traceback_at_exit() -> None:
    done = run_python(
        "from playslot_rl.envs import make_env; a, b = make_env(), make_env(); a.reset(seed=0); print('made')"
    )
    assert done.returncode == 0
    assert "made" in done.stdout
    assert "Traceback" not in done.stderr
    assert "ignored" not in done.stderr


@pytest.mark.integration
def test_renders_although_mujoco_was_imported_without_a_backend() -> None:
    done = run_python(
        "import os; os.environ.pop('MUJOCO_GL', None); os.environ.pop('DISPLAY', None)\n"
        "import mujoco\n"
        "from playslot_rl.envs.rendering import check_rendering; print(check_rendering().shape)"
    )
    assert "(64, 64, 3)" in done.stdout, done.stderr


@pytest.mark.integration
def test_missing_gl_backend_is_one_line() -> None:
    code = (
        "from playslot_rl.envs.rendering import check_rendering\n"
        "from playslot_rl.errors import RenderError\n"
        "try: check_rendering()\n"
        "except RenderError as error: print(error)"
    )
    done = run_python(code, MUJOCO_GL="nonsense")
    assert len(done.stdout.splitlines()) == 1
    assert "set MUJOCO_GL" in done.stdout
    assert "Traceback" not in done.stderr
