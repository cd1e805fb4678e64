"""Rendering: the fast path against MuJoCo's default off-screen settings, same scene, same process."""

from __future__ import annotations

import time
from statistics import median

from playslot_rl.benchmark.spec import Sizes
from playslot_rl.config import EnvConfig, RenderConfig


def render_seconds(sizes: Sizes) -> dict[str, float]:
    """Median seconds a frame: `fast` and `full`; the repeats take turns.

    Raises:
        RenderError: there is no working GL backend.
    """
    from playslot_rl.envs.button_press import ButtonPressEnv

    config = EnvConfig(image_size=sizes.image_size, warmup_steps=1)
    scenes = {
        "full": (ButtonPressEnv(config, RenderConfig(quality="full")), sizes.full_frames),
        "fast": (ButtonPressEnv(config, RenderConfig(quality="fast")), sizes.fast_frames),
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
