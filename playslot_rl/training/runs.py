"""Runs as functions, for callers that have not moved to `playslot_rl.runs` yet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from playslot_rl.config import EnvConfig, ModelConfig
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import StageCheckpoint

if TYPE_CHECKING:
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.world_model import WorldModel


def run_folder(run: Path | str) -> Path:
    """See `Run.open`."""
    return Run.open(run).folder


def adopt_stage(checkpoint: StageCheckpoint, run: Path) -> None:
    """See `Run.take`."""
    Run(run).take(checkpoint)


def use_world_model(run: Path, parent: Path | str) -> None:
    """See `Run.build_on`."""
    Run(run).build_on(Run.open(parent))


def world_model_folder(run: Path | str) -> Path:
    """See `Run.world_run`."""
    return Run.open(run).world_run.folder


def world_model_checkpoints(run: Path | str) -> dict[str, StageCheckpoint]:
    """See `Run.world_stages`."""
    return Run.open(run).world_stages


def stage_config[Group](checkpoint: StageCheckpoint, cls: type[Group], name: str) -> Group:
    """See `StageCheckpoint.group`."""
    return checkpoint.group(cls, name)


def stage_model(checkpoint: StageCheckpoint) -> tuple[ModelConfig, EnvConfig]:
    """See `StageCheckpoint.sizes`."""
    return checkpoint.sizes


def freeze_on(module: nn.Module, device: torch.device | str) -> None:
    """See `StageCheckpoint.restore`."""
    module.to(device).eval().requires_grad_(False)


def slots_checkpoint(run: Path | str) -> StageCheckpoint:
    """See `Run.stage`."""
    return Run.open(run).stage("slots")


def load_savi(run: Path | str, device: torch.device | str = "cpu") -> SAVi:
    """See `Run.load_savi`."""
    return Run.open(run).load_savi(device)


def load_world_model(run: Path | str, device: torch.device | str = "cpu") -> WorldModel:
    """See `Run.load_world_model`."""
    return Run.open(run).load_world_model(device)
