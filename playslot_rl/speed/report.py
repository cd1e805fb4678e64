"""What was measured and counted: a dict for JSON, tables for people, and the machine it belongs to."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any, Final

from playslot_rl.config import BlocksConfig, EnvConfig, ExperimentConfig
from playslot_rl.runtime.devices import device_name
from playslot_rl.runtime.threads import available_cores, set_threads, tune_allocator
from playslot_rl.visualization import document

if TYPE_CHECKING:
    import torch

    from playslot_rl.speed.cases import Sizes
    from playslot_rl.speed.cost import Machine, StageCost

RATES: Final = {"verify": "episodes/s", "export": "episodes/s", "slot_cache": "frames/s"}
PROCESSES: Final = (1, 8, 32)
"""One device, one node of eight, four nodes."""
CPU_BATCH: Final = 4
"""Clips a step on a CPU, on which the paper's 64 would take minutes and 15 GiB."""

Figures = dict[str, dict[str, Any]]
Say = Callable[[str], None]


def measure(sizes: Sizes, threads: int, quick: bool, say: Say) -> Figures:
    """For each case `unit` and the median of each variant in it, and `machine`; a RenderError without a GL backend."""
    from playslot_rl.envs import block_config
    from playslot_rl.speed import cases
    from playslot_rl.speed.sets import render_seconds, set_rates

    tune_allocator()  # as every recipe does
    threads = set_threads(threads)
    side = sizes.config.env.image_size
    button, blocks = EnvConfig(image_size=side, warmup_steps=1), block_config("block_push", BlocksConfig())
    timed: dict[str, tuple[str, Callable[[], dict[str, float]]]] = {
        "savi_step": ("SAVi training step", lambda: cases.savi_step(sizes)),
        "dynamics_step": ("dynamics training step", lambda: cases.dynamics_step(sizes)),
        "rollout_cache": ("rollout", lambda: cases.rollout(sizes)),
        "play_step": ("playing in imagination", lambda: cases.play_step(sizes)),
        "plan_step": ("planning", lambda: cases.plan_step(sizes)),
        "render": ("rendering ButtonPress", lambda: render_seconds(button, sizes.rounds)),
        "render_block_push": (
            "rendering BlockPush", lambda: render_seconds(replace(blocks, image_size=side), sizes.rounds),
        ),
    }  # fmt: skip
    found: Figures = {}
    for name, (title, run) in timed.items():
        say(title)
        found[name] = {"unit": "s", **run()}
    say("window sampling, export, verify, slot cache")
    rates = set_rates(sizes)
    found["window_sampling"] = {"unit": "frames/s", "cache": rates["cache"], "stream": rates["stream"]}
    found |= {name: {"unit": unit, "rate": rates[name]} for name, unit in RATES.items()}
    return {
        **found,
        "machine": {
            **machine("torch", "mujoco", "lerobot"),
            "threads": threads,
            "repeats": sizes.rounds,
            "quick": quick,
        },
    }


def machine(*packages: str) -> dict[str, Any]:
    """Processor, system, and versions."""
    from importlib.metadata import version

    import torch

    return {
        "cpu": device_name(torch.device("cpu")),
        "cores": available_cores(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def table(figures: Figures) -> str:
    """The medians, and the machine, in Markdown."""
    rows = []
    for key, entry in figures.items():
        for name, value in entry.items() if key != "machine" else ():
            if name != "unit":
                shown = f"{value * 1000:,.1f} ms" if entry["unit"] == "s" else f"{value:,.0f} {entry['unit']}"
                rows.append([f"`{key}`", f"`{name}`", shown])
    m = figures["machine"]
    versions = f"Python {m['python']}, torch {m['torch']}, mujoco {m['mujoco']}, lerobot {m['lerobot']}"
    ending = f"{m['cpu']}, {m['cores']} cores, {m['system']}, {versions}; medians of {m['repeats']}"
    return f"{document.table(['case', 'variant', 'median'], rows)}\n\n{ending}"


def cost_tables(config: ExperimentConfig, say: Say) -> str:
    """What each stage's steps take, counted (on the device), then estimated; with `config.device`, but a GPU (see
    `playslot_rl.speed.gpu`), also measured there.
    """
    import torch

    device = torch.device(config.device or "cpu")
    from playslot_rl.speed.cost import Machine, stage_cost
    from playslot_rl.speed.steps import STAGES

    costs = []
    for stage in STAGES:
        say(stage)
        costs.append(stage_cost(config, stage, device))
    tables = [counted(costs), estimated(costs, Machine())]
    if config.device and device.type != "cuda":
        tables.append(measured(config, costs, device, say))
    return "\n\n".join(tables)


def counted(costs: Sequence[StageCost]) -> str:
    """What was counted, a row a stage."""
    titles = ["counted", "parameters trained", "batch", "TFLOP a step", "calls a step"]
    titles += ["kept for backward, fp32", "steps", "PFLOP in all"]
    rows = []
    for cost in costs:
        count = cost.at(cost.batch)
        rows.append([
            cost.stage, f"{cost.parameters:,}", str(cost.batch), f"{count.flops / 1e12:.3g}", f"{count.calls:,.0f}",
            f"{count.kept / 2**30:.2f} GiB", f"{cost.steps:,}", f"{count.flops * cost.steps / 1e15:,.3g}",
        ])  # fmt: skip
    return document.table(titles, rows)


def estimated(costs: Sequence[StageCost], machine: Machine) -> str:
    """Memory and time on `PROCESSES`, a row a stage; what is assumed stands in the first line."""
    from playslot_rl.speed.cost import estimate

    assumed = (
        f"Estimated, assuming {machine.teraflops:g} TFLOP/s sustained a device, {machine.call_us:g} us a kernel at "
        f"least, {machine.gigabytes_s:g} GB/s and {machine.exchange_us:g} us an exchange; "
        "GiB a device, seconds a step, hours:"
    )
    rows, hours = [], dict.fromkeys(PROCESSES, 0.0)
    for cost in costs:
        cells = [cost.stage]
        for n in PROCESSES:
            step = estimate(cost, n, machine)
            hours[n] += step * cost.steps / 3600
            memory = cost.memory(cost.batch / n) / 2**30
            cells.append(f"{memory:.2f} GiB, {step:.3g} s, {step * cost.steps / 3600:.1f} h")
        rows.append(cells)
    rows.append(["all stages", *(f"{total:.0f} h" for total in hours.values())])
    titles = ["estimated", *(f"{n} device{'s' * (n > 1)}" for n in PROCESSES)]
    return f"{assumed}\n\n{document.table(titles, rows)}"


def measured(config: ExperimentConfig, costs: Sequence[StageCost], device: torch.device, say: Say) -> str:
    """Seconds a step and the operations they sustain, a row a stage and precision; of `CPU_BATCH` clips."""
    import torch

    from playslot_rl.speed.steps import precisions, stage_config, time_step

    rows = []
    where = f"this CPU, {torch.get_num_threads()} threads" if device.type == "cpu" else str(device)
    for cost in costs:
        batch = min(cost.batch, CPU_BATCH)
        ways = (False, True) if stage_config(config, cost.stage).compile else (False,)
        for precision, compiled in product(precisions(device.type), ways):
            how = f"{precision}, compiled" if compiled else precision
            say(f"{cost.stage}, {how}")
            took, _ = time_step(config, cost.stage, device, precision, batch, 3, compiled)
            rate = cost.at(batch).flops / took / 1e12
            rows.append([cost.stage, how, str(batch), f"{took:.4g}", f"{rate:.3g}"])
    titles = ["measured", "precision", "batch", "s a step", "TFLOP/s"]
    return f"Measured on {where}, torch {torch.__version__}:\n\n{document.table(titles, rows)}"
