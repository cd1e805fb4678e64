"""What a training step costs, counted: floating-point operations, calls of kernels, bytes kept for the backward pass.

A stage's own loss is computed once with two clips and once with three, forward and backward, on random frames; the
counts are straight lines in the batch (but for a batch of one, which skips some copies), so that two points give any
batch without its time and memory. Nothing is timed here: `estimate` turns the counts into seconds under assumptions.

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

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, StageConfig
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.losses.common import total_loss
from playslot_rl.losses.dynamics import DynamicsLoss
from playslot_rl.losses.slots import SlotsLoss
from playslot_rl.world_model import Agent, WorldModel

STAGES: Final = ("slots", "dynamics", "policy", "decoder")
BYTES: Final = 4
"""Of a number; everything is counted in fp32."""
STATE: Final = 4
"""Numbers kept for each trained one: itself, its gradient, and Adam's two averages."""


@dataclass(frozen=True)
class Count:
    """Of one step, forward and backward, without the optimiser.

    Attributes:
        flops: of matrix products, convolutions and attention; a multiplication and an addition are two.
        calls: of kernels, views not counted.
        kept: bytes of distinct storage kept for the backward pass, weights not counted.
    """

    flops: float
    calls: float
    kept: float


@dataclass(frozen=True)
class StageCost:
    """A stage at the sizes of a config.

    Attributes:
        stage: one of `STAGES`.
        steps: of the whole stage.
        batch: B.
        parameters: that are trained.
        frozen: parameters that are only used.
        two, three: counts with two clips and with three.
    """

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
    """What is assumed of the processes' devices; nothing of it is measured.

    Attributes:
        teraflops: sustained on these networks, of one device.
        call_us: that a kernel takes at least, be it ever so small, microseconds.
        gigabytes_s: at which gradients travel between devices.
        exchange_us: that an exchange takes at least, microseconds.
    """

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


def stage_cost(config: ExperimentConfig, stage: str) -> StageCost:
    """Count a step of a stage.

    Args:
        config: sizes, clips and batch; precision is not looked at.
        stage: one of `STAGES`.

    Raises:
        ValueError: another stage.
    """
    agent = fresh_agent(config)
    criterion, batch_of = parts(config, stage, agent)
    begin(criterion, batch_of(2))
    trained = [p for p in criterion.parameters() if p.requires_grad]
    frozen = sum(p.numel() for p in criterion.parameters()) - sum(p.numel() for p in trained)
    own = stage_config(config, stage)
    return StageCost(
        stage,
        config.behaviour.decoder_steps if stage == "decoder" else own.steps,
        own.batch_size,
        sum(p.numel() for p in trained),
        frozen,
        _count(criterion, batch_of(2)),
        _count(criterion, batch_of(3)),
    )


def config_group(stage: str) -> str:
    """Where a stage's settings are; policy and decoder share theirs."""
    return stage if stage in ("slots", "dynamics") else "behaviour"


def stage_config(config: ExperimentConfig, stage: str) -> StageConfig:
    """The settings of a stage."""
    found: StageConfig = getattr(config, config_group(stage))
    return found


def fresh_agent(config: ExperimentConfig) -> Agent:
    """Untrained networks of a config's sizes, in fp32."""
    torch.manual_seed(0)
    agent = Agent.untrained(WorldModel(config.model, config.env), oracle=False).train()
    agent.world_model.savi.precision = "fp32"
    return agent


def parts(config: ExperimentConfig, stage: str, agent: Agent) -> tuple[nn.Module, Callable[[int], TensorDict]]:
    """A stage's loss, and a random batch of a size for it.

    Raises:
        ValueError: another stage.
    """
    model, side = agent.world_model, config.env.image_size
    slots, frames = model.slot_shape, (3, side, side)
    latent, action = model.latent_shape, (config.env.action_dim,)

    def batch(clips: int, *shapes: tuple[str, tuple[int, ...]]) -> TensorDict:
        return TensorDict({key: torch.rand(clips, *shape) for key, shape in shapes}, [clips])

    if stage == "slots":
        clip = (config.slots.clip_frames, *frames)
        return SlotsLoss(model.savi), lambda n: batch(n, (keys.PIXELS, clip))
    if stage == "dynamics":
        T = config.dynamics.seed_frames + config.dynamics.predicted_frames
        criterion = DynamicsLoss(model.inverse_dynamics, model.predictor, model.savi, config.dynamics)
        own = ((keys.SLOTS, (T, *slots)), (keys.PIXELS, (T, *frames)), (keys.ACTION, (T, *action)))
        return criterion, lambda n: batch(n, *own)
    if stage == "policy":
        return BehaviourLoss(agent.policy), lambda n: batch(n, (keys.SLOTS, slots), (keys.LATENT_ACTION, latent))
    if stage == "decoder":
        seen = ((keys.SLOTS, slots), (keys.LATENT_ACTION, latent), (keys.ACTION, action))
        return ActionDecoderLoss(agent.action_decoder), lambda n: batch(n, *seen)
    raise ValueError(f"stage: got {stage}, expected one of {', '.join(STAGES)}")


class _Calls(TorchDispatchMode):
    """Counts operators that compute something."""

    number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += not func.is_view
        return func(*args, **(kwargs or {}))


def begin(criterion: nn.Module, batch: TensorDict) -> None:
    """One step that is not counted: the codebook begins by k-means."""
    with torch.no_grad():
        criterion(batch)


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
