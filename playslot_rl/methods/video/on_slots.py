"""SlotFormer and OCVP-Seq: a world model in which nothing is inferred, trained on a frozen SAVi's slots."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from playslot_rl.config import DynamicsStageConfig, ExperimentConfig, ModelConfig
from playslot_rl.methods.video.slots import SlotVideo
from playslot_rl.methods.video.training import on_clips
from playslot_rl.runs import Run
from playslot_rl.training.patience import patience_of
from playslot_rl.training.record import StageRecord, Training
from playslot_rl.training.stage_dynamics import dynamics_on_slots
from playslot_rl.world_model import WorldModel


def uncontrolled(config: ExperimentConfig, model: ModelConfig) -> ModelConfig:
    """The sizes of a world model in which nothing is inferred, and the method's predictor predicts."""
    inverse = replace(model.inverse_dynamics, mode="none", variant="single")
    return replace(model, inverse_dynamics=inverse, predictor=getattr(config.baselines, config.method).predictor)


def training(record: StageRecord) -> Training:
    """A new predictor."""
    own: DynamicsStageConfig = getattr(record.config.baselines, record.name)
    stage = dynamics_on_slots(record, record.groups["model"], own)
    return on_clips(record, stage, own, patience_of(own.patience, "mse_slot"))


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
