"""A closed environment leaves its GL context to the next one, which draws what it would have drawn in a new one."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from playslot_rl.config.compose import compose
from playslot_rl.envs import gl_contexts, make_env

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(os.environ.get("MUJOCO_GL") != "egl", reason="contexts are kept where EGL draws"),
]


@pytest.fixture(autouse=True)
def _none_kept() -> Iterator[None]:
    gl_contexts._end()
    yield
    gl_contexts._end()


def made(name: str) -> Any:
    config = compose([f"env={name}", "preset=smoke"])
    return make_env(config.env, config.render)


def first_frame(env: Any) -> npt.NDArray[np.uint8]:
    frame: npt.NDArray[np.uint8] = env.reset(seed=5)[0]["pixels"]
    return frame


def test_the_next_environment_of_any_task_draws_as_in_a_new_context() -> None:
    frames = {}
    for _ in range(2):
        for name in ("block_push_easy", "button_press", "block_push"):
            env = made(name)
            frame = first_frame(env)
            assert len(gl_contexts._free) == 0
            env.close()
            assert len(gl_contexts._free) == 1
            assert np.array_equal(frames.setdefault(name, frame), frame)


def test_two_that_are_open_have_a_context_each() -> None:
    one, other = made("block_push_easy"), made("button_press")
    before = first_frame(one), first_frame(other)
    other.close()
    third = made("block_push")
    first_frame(third)
    assert np.array_equal(first_frame(one), before[0])
    one.close()
    third.close()
    assert len(gl_contexts._free) == 2


def test_closed_by_another_thread_it_is_freed() -> None:
    env = made("block_push_easy")
    frame = first_frame(env)
    thread = threading.Thread(target=env.close)
    thread.start()
    thread.join()
    assert gl_contexts._free == []
    again = made("block_push_easy")
    assert np.array_equal(first_frame(again), frame)
    again.close()


def test_a_forked_process_makes_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    made("block_push_easy").close()
    env = made("block_push_easy")
    env.close()
    parent = gl_contexts._free[0][1]
    monkeypatch.setattr(gl_contexts.os, "getpid", lambda: -1)
    assert gl_contexts._take() is None
    parent.free()


def test_no_more_than_a_few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl_contexts, "KEPT", 1)
    envs = [made("block_push_easy") for _ in range(2)]
    frames = [first_frame(env) for env in envs]
    assert np.array_equal(*frames)
    for env in envs:
        env.close()
    assert len(gl_contexts._free) == 1


def test_full_quality_keeps_its_shadows() -> None:
    frames = []
    for quality in ("fast", "full"):
        config = compose(["env=block_push_easy", "preset=smoke", f"render.quality={quality}"])
        env = make_env(config.env, config.render)
        frames.append(first_frame(env))
        env.close()
    darker = (frames[0].astype(int) - frames[1]).max(-1) > 20
    assert darker.mean() > 0.005, "the arm throws a shadow on the ground"
