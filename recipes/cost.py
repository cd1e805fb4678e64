"""What training takes, estimated before it is begun: `python -m playslot_rl.recipes.cost preset=paper`.

Counts the operations of one step of each stage on this CPU, and prints them with the memory and time that they mean on
1, 8 and 32 devices of which speed is *assumed* (`playslot_rl.speed.cost.Machine`). With `device=` steps are also
*measured* there, in fp32 and, where the processor multiplies it, in bf16: `device=cuda preset=paper` takes a minute on
an H100, `device=cpu` many. Stages of which the setting `compile` is on are measured without and with torch.compile.
Nothing is written.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Final

from playslot_rl.config import ExperimentConfig, Precision
from playslot_rl.config.compose import compose
from playslot_rl.errors import PlaySlotError, explain

if TYPE_CHECKING:
    import torch

    from playslot_rl.speed.cost import Machine, StageCost

PROCESSES = (1, 8, 32)
"""One device, one node of eight, four nodes."""

PRECISIONS: Final[tuple[Precision, ...]] = ("fp32", "bf16")
CPU_BATCH: Final = 4
"""Clips a step on a CPU, on which the paper's 64 would take minutes and 15 GiB."""


def main(config: ExperimentConfig) -> str:
    """The two tables, in Markdown; progress goes to standard error."""
    import torch

    from playslot_rl.runtime.allocator import tune_allocator
    from playslot_rl.runtime.threads import set_threads
    from playslot_rl.speed.cost import STAGES, Machine, stage_cost

    tune_allocator()
    set_threads(config.threads)
    costs: list[StageCost] = []
    for stage in STAGES:
        print(f"{stage} ...", file=sys.stderr, flush=True)
        costs.append(stage_cost(config, stage))
    tables = [counted(costs), estimated(costs, Machine())]
    if config.device:
        tables.append(measured(config, costs, torch.device(config.device)))
    return "\n\n".join(tables)


def counted(costs: Sequence[StageCost]) -> str:
    """What was counted, a row a stage."""
    names = "parameters trained | batch | TFLOP a step | calls a step | kept for backward, fp32 | steps | PFLOP in all"
    lines = [f"| counted | {names} |", "|---|---|---|---|---|---|---|---|"]
    for cost in costs:
        count = cost.at(cost.batch)
        lines.append(
            f"| {cost.stage} | {cost.parameters:,} | {cost.batch} | {count.flops / 1e12:.3g} | {count.calls:,.0f} | "
            f"{count.kept / 2**30:.2f} GiB | {cost.steps:,} | {count.flops * cost.steps / 1e15:,.3g} |"
        )
    return "\n".join(lines)


def estimated(costs: Sequence[StageCost], machine: Machine) -> str:
    """Memory and time on `PROCESSES`, a row a stage; what is assumed stands in the first line."""
    from playslot_rl.speed.cost import estimate

    assumed = (
        f"Estimated, assuming {machine.teraflops:g} TFLOP/s sustained a device, {machine.call_us:g} us a kernel at "
        f"least, {machine.gigabytes_s:g} GB/s and {machine.exchange_us:g} us an exchange; "
        "GiB a device, seconds a step, hours:"
    )
    titles = " | ".join(f"{n} device{'s' * (n > 1)}" for n in PROCESSES)
    lines = [assumed, "", f"| estimated | {titles} |", "|---" * (1 + len(PROCESSES)) + "|"]
    for cost in costs:
        cells = []
        for n in PROCESSES:
            seconds = estimate(cost, n, machine)
            memory = cost.memory(cost.batch / n) / 2**30
            cells.append(f"{memory:.2f} GiB, {seconds:.3g} s, {seconds * cost.steps / 3600:.1f} h")
        lines.append(f"| {cost.stage} | {' | '.join(cells)} |")
    hours = [sum(estimate(cost, n, machine) * cost.steps for cost in costs) / 3600 for n in PROCESSES]
    return "\n".join([*lines, f"| all stages | {' | '.join(f'{total:.0f} h' for total in hours)} |"])


def measured(config: ExperimentConfig, costs: Sequence[StageCost], device: torch.device) -> str:
    """Seconds a step and the operations they sustain, a row a stage and precision; on a CPU of `CPU_BATCH` clips.

    bf16 is left out where the processor does not multiply it.
    """
    import torch

    from playslot_rl.runtime.precision import native_bf16
    from playslot_rl.speed.cost import stage_config
    from playslot_rl.speed.step import time_step

    on_gpu = device.type == "cuda"
    precisions = PRECISIONS if native_bf16(device.type) else PRECISIONS[:1]  # emulated, a step takes ten times as long
    where = torch.cuda.get_device_name(device) if on_gpu else f"this CPU, {torch.get_num_threads()} threads"
    lines = [f"Measured on {where}, torch {torch.__version__}:", ""]
    lines.append("| measured | precision | batch | s a step | TFLOP/s | peak memory |")
    lines.append("|---|---|---|---|---|---|")
    for cost in costs:
        batch = cost.batch if on_gpu else min(cost.batch, CPU_BATCH)
        ways = (False, True) if stage_config(config, cost.stage).compile else (False,)
        for precision, compiled in product(precisions, ways):
            how = f"{precision}, compiled" if compiled else precision
            print(f"{cost.stage}, {how} ...", file=sys.stderr, flush=True)
            took = time_step(config, cost.stage, device, precision, batch, 10 if on_gpu else 3, compiled)
            rate = cost.at(batch).flops / took.seconds / 1e12
            peak = "–" if took.peak is None else f"{took.peak / 2**30:.2f} GiB"
            lines.append(f"| {cost.stage} | {how} | {batch} | {took.seconds:.4g} | {rate:.3g} | {peak} |")
    return "\n".join(lines)


if __name__ == "__main__":
    try:
        print(main(compose(sys.argv[1:])))
    except PlaySlotError as error:
        sys.exit(f"cost: error: {explain(error)}")
