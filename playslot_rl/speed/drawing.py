"""Rendering: the fast path against MuJoCo's default off-screen settings, same scene, same process."""

from __future__ import annotations

import time
from contextlib import ExitStack
from statistics import median
from typing import Any

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.speed.spec import Sizes


def render_seconds(config: EnvConfig, sizes: Sizes) -> dict[str, float]:
    """Median seconds a frame of a task, `full` and `fast`; the repeats take turns.

    Raises:
        RenderError: there is no working GL backend.
    """
    from playslot_rl.envs import make_env

    frames = {"full": sizes.full_frames, "fast": sizes.fast_frames}
    seconds: dict[str, list[float]] = {name: [] for name in frames}
    with ExitStack() as stack:
        tasks: dict[str, Any] = {}
        for name in frames:
            tasks[name] = make_env(config, RenderConfig(quality="full" if name == "full" else "fast")).unwrapped
            stack.callback(tasks[name].close)
            tasks[name].reset(seed=0)
        for _ in range(sizes.repeats + 1):
            for name, count in frames.items():
                begin = time.perf_counter()
                for _ in range(count):
                    tasks[name].draw()
                seconds[name].append((time.perf_counter() - begin) / count)
    return {name: median(times[1:]) for name, times in seconds.items()}
