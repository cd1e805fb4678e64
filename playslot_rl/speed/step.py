"""A training step, timed: forward, backward, clipping and Adam on random frames of a config's sizes, on one device.

The losses are those that `cost` counts, so that seconds stand beside operations. Steps are timed one by one to their
end on the device, after two that are not; their median is given.

Shapes: B clips (or rows) a batch.
"""

from __future__ import annotations

import statistics
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Final

import torch

from playslot_rl.config import ExperimentConfig, Precision
from playslot_rl.losses.common import total_loss
from playslot_rl.runtime.precision import autocast
from playslot_rl.speed.cost import begin, config_group, fresh_agent, parts, stage_config
from playslot_rl.training.compiling import compile_parts
from playslot_rl.training.fit import build_adam

WARM: Final = 2
"""Steps before the first that is timed: kernels are chosen or compiled, the codebook begins."""


@dataclass(frozen=True)
class StepTime:
    """What a step took.

    Attributes:
        stage: one of `cost.STAGES`.
        precision: `fp32` or `bf16`.
        batch: B.
        seconds: median of the steps timed.
        peak: bytes that tensors took on the device at most; None on a CPU, where nobody counts them.
        compiled: whether the networks' parts were kernels of torch.compile.
    """

    stage: str
    precision: Precision
    batch: int
    seconds: float
    peak: int | None
    compiled: bool = False


def time_step(
    config: ExperimentConfig,
    stage: str,
    device: torch.device,
    precision: Precision,
    batch: int = 0,
    steps: int = 10,
    compiled: bool = False,
) -> StepTime:
    """Time the step of a stage.

    Args:
        config: sizes, clips, optimiser.
        stage: one of `cost.STAGES`.
        device: where it runs.
        precision: of convolutions and transformers; weights and optimiser stay in fp32.
        batch: B; 0 takes the config's.
        steps: that are timed.
        compiled: have torch.compile make kernels of what is trained, as the setting `compile` of a stage does.

    Raises:
        ConfigError: no C++ compiler for `compiled`.
        ValueError: another stage.
    """
    own, on_gpu = stage_config(config, stage), device.type == "cuda"
    size = batch or own.batch_size
    agent = fresh_agent(config)
    agent.world_model.savi.precision = precision
    criterion, batch_of = parts(config, stage, agent)
    criterion, data = criterion.to(device), batch_of(size).to(device)
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    begin(criterion, data)
    if compiled:
        compile_parts(dict(criterion.named_children()), f"{config_group(stage)}.compile")
    trained = {name: p for name, p in criterion.named_parameters() if p.requires_grad}
    adam = build_adam(trained, replace(own.optim, warmup_steps=0))

    def step() -> float:
        began = time.perf_counter()
        adam.zero_grad()
        # SAVi surrounds its own convolutions, as it does in training.
        with nullcontext() if stage == "slots" else autocast(device.type, precision):
            out = criterion(data)
        total_loss(out).backward()
        if own.optim.grad_clip > 0:
            torch.nn.utils.clip_grad_norm_(trained.values(), own.optim.grad_clip)
        adam.step()
        if on_gpu:
            torch.cuda.synchronize(device)
        return time.perf_counter() - began

    for _ in range(WARM):
        step()
    seconds = statistics.median(step() for _ in range(steps))
    peak = torch.cuda.max_memory_allocated(device) if on_gpu else None
    return StepTime(stage, precision, size, seconds, peak, compiled)
