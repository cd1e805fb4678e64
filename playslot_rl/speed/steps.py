"""A stage's training step on random frames of a config's sizes, as `fit` takes it.

Shapes: B clips (or rows) a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, Precision, StageConfig
from playslot_rl.config.stages import Execution
from playslot_rl.losses.behaviour import ActionDecoderLoss, BehaviourLoss
from playslot_rl.losses.common import total_loss
from playslot_rl.losses.dynamics import DynamicsLoss
from playslot_rl.losses.slots import SlotsLoss
from playslot_rl.runtime.precision import autocast, native_bf16
from playslot_rl.runtime.shares import own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.speed.timing import timed
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.compiling import compile_parts
from playslot_rl.training.optimizer import build_adam, trainable_parameters
from playslot_rl.training.steps import WARM, Steps
from playslot_rl.world_model import Agent, WorldModel

STAGES: Final = ("slots", "dynamics", "policy", "decoder")
Step = Callable[[], Tensor]
"""Computes once and returns a scalar, the loss where there is one."""


def precisions(device_type: str) -> tuple[Precision, ...]:
    """Without bf16 where it is only emulated: a step would take ten times as long."""
    return ("fp32", "bf16") if native_bf16(device_type) else ("fp32",)


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


def begin(criterion: nn.Module, batch: TensorDict) -> None:
    """One step that is not counted: the codebook begins by k-means."""
    with torch.no_grad():
        criterion(batch)


class RandomStage:
    """A stage, one of `STAGES`, that sees the same random batch (of the config's size where it is 0) in every step.

    The precision is that of convolutions and transformers; weights and optimiser stay in fp32.

    Raises:
        ValueError: another stage.
    """

    def __init__(
        self,
        config: ExperimentConfig,
        stage: str,
        device: torch.device,
        precision: Precision,
        agent: Agent | None = None,
        batch: int = 0,
    ) -> None:
        own = stage_config(config, stage)
        self.group, self.optim, self.size = config_group(stage), own.optim, batch or own.batch_size
        agent = fresh_agent(config) if agent is None else agent
        agent.world_model.savi.precision = precision
        criterion, batch_of = parts(config, stage, agent)
        self.criterion, self.data = criterion.to(device), batch_of(self.size).to(device)
        # SAVi surrounds its own convolutions, as it does in training.
        self.surrounded = nullcontext() if stage == "slots" else autocast(device.type, precision)
        self.device = device
        begin(self.criterion, self.data)

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        return dict(self.criterion.named_children())

    def batch(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        rows = own_rows(torch.arange(self.size, device=self.device))
        return {key: value[rows] for key, value in self.data.items()}

    def loss(self, batch: Mapping[str, Tensor], step: int, generators: StepGenerators) -> Mapping[str, Tensor]:  # noqa: ARG002
        with self.surrounded:
            out = self.criterion(TensorDict(dict(batch)), generators.torch("noise"))
        return {"loss": total_loss(out)}

    def validate(self, step: int) -> Mapping[str, float]:  # noqa: ARG002
        return {}

    def step(self, execution: Execution = "eager") -> Step:
        """What takes one step, of this process's share of the batch where there are several."""
        parameters = trainable_parameters({"loss": self.criterion})
        optim = replace(self.optim, warmup_steps=0, accumulate=1)
        config = replace(StageConfig(), batch_size=self.size, optim=optim, execution=execution)
        batches = GlobalBatches(self, config, parameters, self.group)
        batches.meet()
        steps = Steps(self.group, self.group, batches, build_adam(parameters, optim), config, 0, self.device)
        return lambda: steps.take(0, optim.lr)["loss"]


def time_step(
    config: ExperimentConfig,
    stage: str,
    device: torch.device,
    precision: Precision,
    batch: int = 0,
    steps: int = 10,
    compiled: bool | str = False,
    execution: Execution = "eager",
) -> tuple[float, int | None]:
    """Seconds a step, of `steps` in a row, and the bytes that tensors took on the device at most (None on a CPU).

    Those in which kernels are chosen, compiled or captured are not counted.

    Raises:
        ConfigError: no C++ compiler for `compiled`, which has torch.compile make kernels, as `compile` of a stage does,
            or those of the one network that it names; `execution` is graph without a GPU.
        ValueError: another stage.
    """

    def make() -> Step:
        made = RandomStage(config, stage, device, precision, batch=batch)
        if compiled:
            modules = {name: module for name, module in made.modules.items() if compiled in (True, name)}
            compile_parts(modules, f"{made.group}.compile")
        step = made.step(execution)
        for _ in range(WARM + 1 if execution == "graph" else 0):
            step()
        return step

    return timed(make, device, steps)
