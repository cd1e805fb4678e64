"""Config of one training: steps, batch, optimiser (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.plain import check

Precision = Literal["fp32", "bf16"]


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its schedule.

    Attributes:
        lr: base learning rate.
        warmup_steps: linear warm-up.
        schedule: `cosine` to zero over the stage's steps after warm-up, or `constant`.
        grad_clip: maximum gradient norm; 0 switches clipping off.
    """

    lr: float = 1e-4
    warmup_steps: int = 0
    schedule: Literal["cosine", "constant"] = "cosine"
    grad_clip: float = 0.05


@dataclass(frozen=True)
class StageConfig:
    """What every training stage has.

    Attributes:
        steps: optimiser steps.
        batch_size: windows per step.
        optim: optimiser.
        precision: `bf16` autocasts the convolutions.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.
        log_every: steps between log lines.
    """

    steps: int = 200_000
    batch_size: int = 64
    optim: OptimConfig = field(default_factory=OptimConfig)
    precision: Precision = "fp32"
    checkpoint_every: int = 1000
    validate_every: int = 1000
    log_every: int = 50

    def __post_init__(self) -> None:
        check(self.steps >= 1, "steps", self.steps, "at least 1")
        check(self.batch_size >= 1, "batch_size", self.batch_size, "at least 1")
        check(self.checkpoint_every >= 1, "checkpoint_every", self.checkpoint_every, "at least 1")
