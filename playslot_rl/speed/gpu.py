"""What a GPU makes of training steps, searches and games: kernels launched one by one, captured, and compiled as well.

Beside a case, whose variants `PRESET_PRECISION_WAY` are seconds, stand `CASE_memory` (GiB that tensors took at most, of
each variant), `CASE_arithmetic` (TFLOP, of each preset) and `CASE_batch`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, Final

import torch

from playslot_rl.config import ExperimentConfig, Precision
from playslot_rl.config.compose import compose
from playslot_rl.config.stages import Execution
from playslot_rl.errors import ConfigError, explain
from playslot_rl.play.pictures import game
from playslot_rl.runtime.captured import uncaptured
from playslot_rl.runtime.precision import native_bf16
from playslot_rl.speed.cases import Sizes, plan_towards_goal, prepared, quick_sizes
from playslot_rl.speed.cost import operations, stage_cost
from playslot_rl.speed.report import Figures, Say, machine
from playslot_rl.speed.steps import Step, fresh_agent, precisions, stage_config, time_step
from playslot_rl.speed.timing import seconds, timed
from playslot_rl.visualization import document

PRESETS: Final = {"compact": "block_push_easy", "paper": "button_press"}
"""The task of each."""
STAGES: Final = {"savi_step": "slots", "dynamics_step": "dynamics", "policy_step": "policy"}
CASES: Final = (*STAGES, "plan_step", "play_step")
WAYS: Final = ("eager", "captured", "compiled")
"""Kernels launched one by one; in CUDA graphs; in graphs, SAVi's made by torch.compile, as the commands have it."""
UNITS: Final = {
    "": "s",
    "_memory": "GiB",
    "_share": "% of the peak arithmetic",
    "_arithmetic": "TFLOP",
    "_batch": "rows",
}
STEPS: Final = 10
"""Timed steps in a row; searches and games are timed `GAMES` times."""
GAMES: Final = 3
FRAMES: Final = 10
"""Imagined frames of a game."""
PRODUCT: Final = 8192
"""Rows and columns of the matrices whose product shows the peak arithmetic."""


def measure(device: torch.device, threads: int, quick: bool, say: Say) -> Figures:
    """Figures as `playslot_rl.speed.report.measure` gives them. A variant that the device cannot compute is said and
    left out. On a CPU kernels are launched one by one only."""
    sizes, found = quick_sizes() if quick else Sizes(), empty()
    say("peak arithmetic")
    peak = peak_flops(device, PRODUCT // 32 if quick else PRODUCT)
    presets = (
        {"smoke": sizes.config} if quick else {p: compose([f"preset={p}", f"env={e}"]) for p, e in PRESETS.items()}
    )
    for preset, config in presets.items():
        for case in CASES:
            say(f"{case}, {preset}")
            batch, arithmetic = work(case, config, sizes, device)
            found[f"{case}_batch"][preset], found[f"{case}_arithmetic"][preset] = batch, arithmetic / 1e12
            for precision, way in variants(case, preset, device):
                name = f"{preset}_{precision}_{way}"
                try:
                    took, memory = _timed(case, config, sizes, device, precision, way)
                except (RuntimeError, ConfigError) as error:
                    say(f"{case}: {name} is left out: {explain(error)}")
                    continue
                found[case][name], found[f"{case}_share"][name] = took, 100 * arithmetic / took / peak
                if memory is not None:
                    found[f"{case}_memory"][name] = memory / 2**30
    own: dict[str, Any] = {"gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)}
    own |= {"peak_tflops": peak / 1e12, "threads": threads, "repeats": STEPS, "quick": quick}
    return {**found, "machine": {**machine("torch"), **own}}


def empty() -> Figures:
    """All cases, without a figure."""
    return {f"{case}{of}": {"unit": unit} for case in CASES for of, unit in UNITS.items()}


def variants(case: str, preset: str, device: torch.device) -> list[tuple[Precision, str]]:
    """Precisions and ways in which a case is timed; a search computes in fp32 whatever the precision."""
    ways = WAYS[: 3 if preset == "paper" and case in ("savi_step", "dynamics_step") else 2]
    if device.type != "cuda":
        ways = WAYS[:1]
    kinds: tuple[Precision, ...] = ("fp32",) if case == "plan_step" else precisions(device.type)
    # What is compiled, for long trainings, is what they compute in: the last of them, bf16 where there is it.
    return [(precision, way) for precision in kinds for way in ways if way != "compiled" or precision == kinds[-1]]


def peak_flops(device: torch.device, side: int) -> float:
    """Operations a second that a large matrix product sustains, in bf16 where that is not emulated."""
    dtype = torch.bfloat16 if native_bf16(device.type) else torch.float32
    a, b = (torch.randn(side, side, device=device, dtype=dtype) for _ in range(2))
    return 2 * side**3 / seconds(lambda: a @ b, 3 * STEPS)


def work(case: str, config: ExperimentConfig, sizes: Sizes, device: torch.device) -> tuple[int, float]:
    """Rows of a batch (of a search: candidates), and the operations of one step."""
    if case in STAGES:
        batch = stage_config(config, STAGES[case]).batch_size
        return batch, stage_cost(config, STAGES[case], device).at(batch).flops
    with uncaptured():
        flops = operations(_made(case, config, sizes, device, "fp32")())
    return (sizes.plan[0], flops) if case == "plan_step" else (1, flops / FRAMES)


def _timed(
    case: str, config: ExperimentConfig, sizes: Sizes, device: torch.device, precision: Precision, way: str
) -> tuple[float, int | None]:
    if case in STAGES:
        compiled = "savi" if way == "compiled" else False
        if compiled:
            torch.compiler.reset()  # only so many variants of a function are kept
        execution: Execution = "eager" if way == "eager" else "graph"
        return time_step(config, STAGES[case], device, precision, 0, STEPS, compiled, execution)
    with uncaptured() if way == "eager" else nullcontext():
        took, memory = timed(_made(case, config, sizes, device, precision), device, GAMES)
    return took / (FRAMES if case == "play_step" else 1), memory


def _made(
    case: str, config: ExperimentConfig, sizes: Sizes, device: torch.device, precision: Precision
) -> Callable[[], Step]:
    """What makes a search or a game with a fresh model."""

    def make() -> Step:
        agent = fresh_agent(config).to(device)
        model = prepared(agent.world_model, precision)
        return plan_towards_goal(agent, sizes) if case == "plan_step" else game(model, FRAMES)

    return make


def rows(figures: Figures) -> list[list[Any]]:
    """A row for each case, preset and precision: milliseconds of each way, how many times quicker captured is, and of
    the quickest way its memory (GiB) and its share of the peak arithmetic (%); None where nothing was measured."""
    found = []
    for case in CASES:
        for kind in dict.fromkeys(name.rpartition("_")[0] for name in figures[case] if name != "unit"):
            preset, precision = kind.split("_")
            took = [figures[case].get(f"{kind}_{way}") for way in WAYS]
            least = min(value for value in took if value is not None)
            times = took[0] / took[1] if took[0] and took[1] else None
            memory = figures[f"{case}_memory"].get(f"{kind}_{WAYS[took.index(least)]}")
            tflop = figures[f"{case}_arithmetic"].get(preset)
            share = None if tflop is None else 100 * tflop / least / figures["machine"]["peak_tflops"]
            milliseconds = [None if value is None else 1000 * value for value in took]
            numbers = [*milliseconds[:2], times, milliseconds[2], memory, share]
            head = [f"`{case}`", preset, precision, figures[f"{case}_batch"].get(preset)]
            found.append([*head, *(None if value is None else float(f"{value:.3g}") for value in numbers)])
    return found


def table(figures: Figures) -> str:
    """The rows, and the machine, in Markdown."""
    titles = ["case", "preset", "precision", "batch", "eager", "captured", "times", "compiled, too", "peak memory"]
    units = ["", "", "", "", " ms", " ms", "", " ms", " GiB", " %"]
    cells = [
        ["–" if value is None else f"{value}{unit}" for value, unit in zip(row, units, strict=True)]
        for row in rows(figures)
    ]
    m = figures["machine"]
    ending = f"{m['gpu']}, torch {m['torch']}, {m['cpu']}, {m['cores']} cores; {m['repeats']} steps in a row; "
    ending += f"peak arithmetic: a large product, {m['peak_tflops']:.3g} TFLOP/s"
    return f"{document.table([*titles, 'share of peak'], cells)}\n\n{ending}"
