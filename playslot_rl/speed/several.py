"""Two processes of one thread against one process of two threads: a training step of SAVi on equal cores.

Both compute the same global batch, by `playslot_rl.training.batches`, as `fit` does: the two processes half of it each,
with one flat sum of the gradients between the backward pass and the clipping.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from statistics import median

import torch
from torch import Tensor, nn

from playslot_rl.config import SlotsStageConfig
from playslot_rl.modules.savi import SAVi
from playslot_rl.runtime import processes
from playslot_rl.runtime.processes import free_port
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.speed.cases import OPTIM, Sizes, Step, Variant, build_savi, slots_loss, training_step
from playslot_rl.speed.race import Child, start
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.fit import trainable_parameters

CORES = 2


def teams() -> dict[str, list[tuple[Variant, int]]]:
    """The processes of each side, with their threads."""
    alone = Variant("ddp_2")
    port = free_port()
    ranks = [replace(alone, rank=rank, world=CORES, port=port) for rank in range(CORES)]
    return {"one_process_two_threads": [(alone, CORES)], "two_processes": [(rank, 1) for rank in ranks]}


def several_seconds(sizes: Sizes) -> dict[str, float]:
    """Median seconds a step of `one_process_two_threads` and of `two_processes`, which take turns.

    Raises:
        PlaySlotError: a process failed or was killed.
    """
    with ExitStack() as stack:
        running = {
            name: [stack.enter_context(start(name, variant, sizes, threads)) for variant, threads in team]
            for name, team in teams().items()
        }
        for child in (child for team in running.values() for child in team):
            child.answer()
        seconds: dict[str, list[float]] = {name: [] for name in running}
        for _ in range(sizes.repeats + 1):
            for name, team in running.items():
                seconds[name].append(_together(team))
    return {name: median(values[1:]) for name, values in seconds.items()}


def _together(team: Sequence[Child]) -> float:
    """Seconds of one step that all processes of a team compute at once: those of the slowest."""
    for child in team:
        child.begin()
    return max(float(child.answer()["seconds"]) for child in team)


def several_step(variant: Variant, sizes: Sizes) -> Step:
    """SAVi's training step in one of `variant.world` processes; its loss is that of the global batch."""
    if variant.world > 1:
        os.environ |= processes.launcher_variables(variant.rank, variant.world, variant.port)
        processes.start("cpu")
    stage = _SharedSAVi(build_savi(variant, sizes), sizes)
    config = SlotsStageConfig(batch_size=sizes.shared_batch, optim=OPTIM)
    batches = GlobalBatches(stage, config, trainable_parameters(stage.modules), "slots")
    batches.meet()
    return training_step(stage.modules, lambda: batches.backward(0, 0, "cpu")["loss"])


class _SharedSAVi:
    """A stage that reconstructs the same clips in every step."""

    def __init__(self, savi: SAVi, sizes: Sizes) -> None:
        self.savi = savi
        self.frames = torch.rand(sizes.shared_batch, sizes.savi_frames, 3, sizes.image_size, sizes.image_size)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return {"savi": self.savi}

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        return {"loss": slots_loss(self.savi, own_rows(self.frames), generators.torch("slots"))}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        return {}
