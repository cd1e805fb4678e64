"""Trainings of methods that clone latent actions."""

from __future__ import annotations

from typing import Literal

from playslot_rl.config.stages import OptimConfig, StageConfig


def clipped_stage(steps: int, lr: float, schedule: Literal["cosine", "constant"]) -> StageConfig:
    """Batches of 64, without warm-up, gradients clipped at 1."""
    return StageConfig(
        steps=steps, batch_size=64, optim=OptimConfig(lr=lr, warmup_steps=0, schedule=schedule, grad_clip=1.0)
    )
