"""Rendering: the fast path against MuJoCo's default off-screen settings, same scene, same process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING

from playslot_rl.config import BlocksConfig, EnvConfig, RenderConfig
from playslot_rl.speed.spec import Sizes

if TYPE_CHECKING:
    from playslot_rl.envs.block_push import BlockEnv
    from playslot_rl.envs.button_press import ButtonPressEnv


def render_seconds(sizes: Sizes) -> dict[str, float]:
    """ButtonPress: median seconds a frame, `fast` and `full`; the repeats take turns.

    Raises:
        RenderError: there is no working GL backend.
    """
    from playslot_rl.envs.button_press import ButtonPressEnv

    config = EnvConfig(image_size=sizes.image_size, warmup_steps=1)
    return _race(sizes, lambda render: ButtonPressEnv(config, render))


def render_block_push_seconds(sizes: Sizes) -> dict[str, float]:
    """BlockPush: median seconds a frame, `fast` and `full`; the repeats take turns.

    Raises:
        RenderError: there is no working GL backend.
    """
    from playslot_rl.envs.block_ids import block_config
    from playslot_rl.envs.block_push import BlockPushEnv

    config = replace(block_config("block_push", BlocksConfig()), image_size=sizes.image_size)
    return _race(sizes, lambda render: BlockPushEnv(config, render))


def _race(sizes: Sizes, make: Callable[[RenderConfig], BlockEnv | ButtonPressEnv]) -> dict[str, float]:
    scenes = {
        "full": (make(RenderConfig(quality="full")), sizes.full_frames),
        "fast": (make(RenderConfig(quality="fast")), sizes.fast_frames),
    }
    seconds: dict[str, list[float]] = {name: [] for name in scenes}
    try:
        for env, _ in scenes.values():
            env.reset(seed=0)
        for _ in range(sizes.repeats + 1):
            for name, (env, frames) in scenes.items():
                begin = time.perf_counter()
                for _ in range(frames):
                    env.draw()
                seconds[name].append((time.perf_counter() - begin) / frames)
    finally:
        for env, _ in scenes.values():
            env.close()
    return {name: median(times[1:]) for name, times in seconds.items()}
