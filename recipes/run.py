"""Runs as functions, for recipes that have not moved to `playslot_rl.runs` yet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import PRETRAINED
from playslot_rl.runs import Run, opening
from playslot_rl.runtime import devices

if TYPE_CHECKING:
    import torch

    from playslot_rl.storage.checkpoints import StageCheckpoint


def open_run(config: ExperimentConfig) -> Path:
    """See `run_to_write`."""
    return opening.run_to_write(config).folder


def open_device(config: ExperimentConfig) -> torch.device:
    """See `playslot_rl.runtime.devices.open_device`."""
    return devices.open_device(config.device, config.threads)


def parent_run(config: ExperimentConfig, folder: Path) -> str:
    """See `Run.of`."""
    return f"{PRETRAINED}/{config.env.name}" if config.run == PRETRAINED else config.run or str(folder)


def require_parent(config: ExperimentConfig, run: Path, parent: StageCheckpoint, *sizes: str) -> None:
    """See `playslot_rl.runs.opening.require_parent`."""
    opening.require_parent(config, Run(run), parent, *sizes)
