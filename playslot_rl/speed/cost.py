"""What a training step costs, counted: floating-point operations, calls of kernels, bytes kept for the backward pass.

A stage's own loss is computed with two clips and with three, forward and backward, on random frames; the counts are
straight lines in the batch (but for a batch of one, which skips some copies), so that two points give any batch.

    c(B) = c(2) + (B - 2) (c(3) - c(2))

Shapes: B clips (or rows) a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from playslot_rl.config import ExperimentConfig
from playslot_rl.losses.common import total_loss
from playslot_rl.speed.steps import begin, fresh_agent, parts, stage_config

CPU: Final = torch.device("cpu")
BYTES: Final = 4
"""Of a number; everything is counted in fp32."""
STATE: Final = 4
"""Numbers kept for each trained one: itself, its gradient, and Adam's two averages."""


@dataclass(frozen=True)
class Count:
    """Of one step, forward and backward, without the optimiser: floating-point operations (a multiplication and an
    addition are two), calls of kernels (views are none), bytes kept for the backward pass (weights are none)."""

    flops: float
    calls: float
    kept: float


@dataclass(frozen=True)
class StageCost:
    """A stage at the sizes of a config: parameters that are trained and that are only used, counts with two clips and
    with three."""

    stage: str
    steps: int
    batch: int
    parameters: int
    frozen: int
    two: Count
    three: Count

    def at(self, batch: float) -> Count:
        """The counts with so many clips."""

        def line(first: float, second: float) -> float:
            return first + (batch - 2) * (second - first)

        two, three = self.two, self.three
        return Count(line(two.flops, three.flops), line(two.calls, three.calls), line(two.kept, three.kept))

    def memory(self, batch: float) -> float:
        """Bytes: weights, gradients, Adam's state, and what is kept for the backward pass."""
        return BYTES * (STATE * self.parameters + self.frozen) + self.at(batch).kept


@dataclass(frozen=True)
class Machine:
    """What is assumed of the processes' devices: what one sustains on these networks, what a kernel takes at least, how
    fast gradients travel between two, and what an exchange of them takes at least."""

    teraflops: float = 20.0
    call_us: float = 8.0
    gigabytes_s: float = 20.0
    exchange_us: float = 50.0


def estimate(cost: StageCost, processes: int, machine: Machine) -> float:
    """Seconds a step, estimated: arithmetic or calls, whichever takes longer, and one exchange of the gradients.

    A ring sends and receives every gradient nearly twice.
    """
    count = cost.at(cost.batch / processes)
    busy = max(count.flops / (machine.teraflops * 1e12), count.calls * machine.call_us * 1e-6)
    if processes == 1:
        return busy
    sent = 2 * (processes - 1) / processes * BYTES * cost.parameters
    return busy + sent / (machine.gigabytes_s * 1e9) + machine.exchange_us * 1e-6


def stage_cost(config: ExperimentConfig, stage: str, device: torch.device = CPU) -> StageCost:
    """Count a step of a stage, in fp32; on a GPU that is quicker.

    Raises:
        ValueError: another stage.
    """
    agent = fresh_agent(config)
    criterion, batch_of = parts(config, stage, agent)
    criterion = criterion.to(device)
    begin(criterion, batch_of(2).to(device))
    trained = [p for p in criterion.parameters() if p.requires_grad]
    frozen = sum(p.numel() for p in criterion.parameters()) - sum(p.numel() for p in trained)
    own = stage_config(config, stage)
    return StageCost(
        stage,
        config.behaviour.decoder_steps if stage == "decoder" else own.steps,
        own.batch_size,
        sum(p.numel() for p in trained),
        frozen,
        _count(criterion, batch_of(2).to(device)),
        _count(criterion, batch_of(3).to(device)),
    )


def operations(call: Callable[[], Any]) -> float:
    """Floating-point operations of a call."""
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as flops:
        call()
    return float(flops.get_total_flops())


class _Calls(TorchDispatchMode):
    """Counts operators that compute something."""

    number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += not func.is_view
        return func(*args, **(kwargs or {}))


def _count(criterion: nn.Module, batch: TensorDict) -> Count:
    own, kept = {p.untyped_storage().data_ptr() for p in criterion.parameters()}, dict[int, int]()

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    criterion.zero_grad()  # a second gradient would be added to the first
    # Attention as plain products: not every fused kernel is known to the counter.
    calls = _Calls()  # type: ignore[no-untyped-call]
    with sdpa_kernel(SDPBackend.MATH), calls, FlopCounterMode(display=False) as flops:
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            out = criterion(batch)
        total_loss(out).backward()
    return Count(float(flops.get_total_flops()), float(calls.number), float(sum(kept.values())))
