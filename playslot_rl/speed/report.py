"""The benchmark's figures: a dict for JSON, a table for people, and the machine they belong to."""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from playslot_rl.config import BlocksConfig, EnvConfig
from playslot_rl.runtime.threads import available_cores
from playslot_rl.speed.cases import (
    Sizes,
    computed_here,
    dynamics_variants,
    play_variants,
    rollout_variants,
    savi_variants,
)
from playslot_rl.speed.plan import plan_variants
from playslot_rl.visualization import document

TARGETS: Final = {
    "savi_step": 2.5,
    "dynamics_step": 2.5,
    "rollout_cache": 3.0,
    "window_sampling": 20.0,
    "render": 12.0,
    "render_block_push": 5.0,
    "play_step": 10.0,
    "plan_step": 3.0,
    "verify": 20.0,
    "export": 20.0,
    "slot_cache": 20.0,
    "ddp_2": 1.0,
}
"""Ratios that the project asks of itself (on two CPU cores); of `play_step`, imagined frames a second, of `verify` and
`export` episodes a second, of `slot_cache` frames a second.
"""
FAST_SAVI: Final = "collapsed_{}_allocator"
"""The fast path of `savi_step`, in the precision that this processor is fastest in."""
RATES: Final = {"verify": "episodes/s", "export": "episodes/s", "slot_cache": "frames/s"}

Figures = dict[str, Any]


def measure(
    sizes: Sizes, threads: int = 0, quick: bool = False, say: Callable[[str], None] = lambda _: None
) -> Figures:
    """Time everything.

    Args:
        sizes: sizes and repeats.
        threads: torch threads of each child; 0 leaves torch's choice.
        quick: recorded in the result: the sizes are not the paper's.
        say: told what is being timed.

    Returns:
        For each key of `TARGETS` a dict with `ratio`, `unit` and the medians it was made of (see `computed_here`), and
        `machine`. The `ratio` of `play_step` is imagined frames a second, that of `RATES` what they say.

    Raises:
        PlaySlotError: a child died. RenderError: no GL backend.
    """
    from playslot_rl.envs import block_config
    from playslot_rl.runtime.allocator import tune_allocator
    from playslot_rl.runtime.precision import resolve_precision
    from playslot_rl.speed.frames import render_seconds, sampling_rates
    from playslot_rl.speed.race import race
    from playslot_rl.speed.sets import set_rates
    from playslot_rl.speed.several import several_seconds

    tune_allocator()  # of this process, which samples windows, as every recipe does; each child sets its own
    say("SAVi training step, its variants")
    savi = race(computed_here(savi_variants()), sizes, threads)
    say("dynamics training step")
    dynamics = race(dynamics_variants(sizes.decoded_frames), sizes, threads)
    say("SAVi training step, two processes against two threads")
    several = several_seconds(sizes)
    say("rollout, cached against full")
    rollout = race(rollout_variants(), sizes, threads)
    say("playing in imagination")
    play = race(computed_here(play_variants()), sizes, threads)
    say("planning, our CEM against TorchRL's")
    plan = race(plan_variants(), sizes, threads)
    say("window sampling against LeRobotDataset + DataLoader")
    rates = sampling_rates(sizes)
    say("export, verify, slot cache")
    sets = set_rates(sizes)
    say("rendering, fast against default")
    render = render_seconds(EnvConfig(image_size=sizes.image_size, warmup_steps=1), sizes)
    block_push = replace(block_config("block_push", BlocksConfig()), image_size=sizes.image_size)
    blocks = render_seconds(block_push, sizes)
    return {
        "savi_step": _entry(savi, "plain_fp32_glibc", FAST_SAVI.format(resolve_precision("auto", "cpu"))),
        "dynamics_step": _entry(dynamics, "plain_fp32_glibc", "fast"),
        "rollout_cache": _entry(rollout, "full", "cached"),
        "window_sampling": {"ratio": rates["cache"] / rates["lerobot"], "unit": "frames/s", **rates},
        "render": _entry(render, "full", "fast"),
        "render_block_push": _entry(blocks, "full", "fast"),
        "play_step": _played(play, sizes.play_steps),
        "plan_step": _entry(plan, "torchrl", "own"),
        **{name: {"ratio": sets[name], "unit": unit, "rate": sets[name]} for name, unit in RATES.items()},
        "ddp_2": _entry(several, "one_process_two_threads", "two_processes"),
        "machine": {**_machine(), "threads": threads, "repeats": sizes.repeats, "quick": quick},
    }


def _entry(seconds: Mapping[str, float], slow: str, fast: str) -> Figures:
    return {"ratio": seconds[slow] / seconds[fast], "unit": "s", **seconds}


def _played(seconds: Mapping[str, float], steps: int) -> Figures:
    """Imagined frames a second with the shipped model, and the seconds of one frame, by name."""
    one = {name: value / steps for name, value in seconds.items()}
    return {"ratio": 1.0 / one["shipped"], "unit": "s", **one}


def _machine() -> Figures:
    """What the figures were measured on."""
    from importlib.metadata import version

    return {
        "cpu": _cpu(),
        "cores": available_cores(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": version("torch"),
        "mujoco": version("mujoco"),
        "lerobot": version("lerobot"),
    }


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def table(figures: Figures) -> str:
    """Markdown: one table of ratios, one of the medians behind them."""
    ratios = [[f"`{key}`", f"{figures[key]['ratio']:.1f}", f"{target:g}"] for key, target in TARGETS.items()]
    medians = []
    for key in TARGETS:
        unit = figures[key]["unit"]
        for name, value in figures[key].items():
            if name not in ("ratio", "unit"):
                shown = f"{value * 1000:,.1f} ms" if unit == "s" else f"{value:,.0f} {unit}"
                medians.append([f"`{key}`", f"`{name}`", shown])
    m = figures["machine"]
    versions = f"Python {m['python']}, torch {m['torch']}, mujoco {m['mujoco']}, lerobot {m['lerobot']}"
    parts = [
        document.table(["case", "ratio", "target"], ratios),
        document.table(["case", "variant", "median"], medians),
        f"{m['cpu']}, {m['cores']} cores, {m['system']}, {versions}; medians of {m['repeats']}",
    ]
    return "\n\n".join(parts)
