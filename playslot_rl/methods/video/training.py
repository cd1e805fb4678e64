"""What the trainings of models that predict frames share; SlotFormer's and OCVP-Seq's, in which nothing is inferred."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import nn

from playslot_rl.config import DynamicsStageConfig, ExperimentConfig, ModelConfig
from playslot_rl.errors import ConfigError
from playslot_rl.methods.video.predictor import SlotVideo
from playslot_rl.runs import Run
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.patience import patience_of
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.training.stage_dynamics import dynamics_on_slots
from playslot_rl.world_model import WorldModel


def pixel_model[Model: nn.Module](build: Callable[[Any, int], Model], own: Any, record: StageRecord) -> Model:
    """A new model of frames; a ConfigError where its convolutions do not fit the frames' size."""
    with global_seed(record.config.seed, 0, record.name):
        return _fitting(build, own, record.config, record.name).to(record.device)


def check_pixel_model(build: Callable[[Any, int], nn.Module], config: ExperimentConfig, name: str) -> None:
    """Refuse frames that a model of frames cannot take, before anything is computed; raises as `pixel_model`."""
    with torch.device("meta"):
        _fitting(build, getattr(config.baselines, name), config, name)


def _fitting[Model: nn.Module](
    build: Callable[[Any, int], Model], own: Any, config: ExperimentConfig, name: str
) -> Model:
    try:
        return build(own, config.env.image_size)
    except ValueError as error:
        raise ConfigError(f"env.{error}: change it, or leave out method {name}") from None


def uncontrolled(config: ExperimentConfig, model: ModelConfig) -> ModelConfig:
    inverse = replace(model.inverse_dynamics, mode="none", variant="single")
    return replace(model, inverse_dynamics=inverse, predictor=getattr(config.baselines, config.method).predictor)


def training(record: StageRecord) -> Training:
    own: DynamicsStageConfig = getattr(record.config.baselines, record.name)
    stage = dynamics_on_slots(record, record.groups["model"], own)
    return on_clips(record, stage, own, patience=patience_of(own.patience, "mse_slot"))


def _load(name: str, run: Run, device: torch.device | str = "cpu") -> SlotVideo:
    """The predictor of a finished run; a CheckpointError where it is missing, damaged, or of other slots."""
    done = run.stage(name, "slots")
    sizes, env = done.sizes
    model = replace(sizes, savi=run.stage("slots").sizes[0].savi)
    world = done.restore(lambda: WorldModel(model, env), ("inverse_dynamics", "predictor"), device)
    world.savi = run.load_savi(device)
    return SlotVideo(world)


slotformer = partial(_load, "slotformer")
ocvp_seq = partial(_load, "ocvp_seq")
