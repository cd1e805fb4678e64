"""Config of LAPO."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.plain import check
from playslot_rl.config.stage import OptimConfig, StageConfig


def _stage(steps: int, lr: float, schedule: Literal["cosine", "constant"]) -> StageConfig:
    return StageConfig(
        steps=steps, batch_size=64, optim=OptimConfig(lr=lr, warmup_steps=0, schedule=schedule, grad_clip=1.0)
    )


@dataclass(frozen=True)
class LAPOConfig:
    """Sizes and schedule of LAPO. The action decoder's size is `model.action_decoder`, its inputs
    `behaviour.decoder_inputs`, its labels `behaviour.labelled_demos`: as for PlaySlot.

    Attributes:
        channels: of the convolutional encoders; each halves the resolution.
        hidden: width of the layer between an encoder and its output.
        groups: G codes that make up a latent action.
        code_dim: width of each, so that a latent action has `groups * code_dim` numbers.
        codes: K entries of the codebook, which the groups share.
        decay: of the codebook's moving average.
        dead_threshold: EMA cluster size under which a code is revived.
        commitment: weight beta of the commitment term.
        loss: of the latent policy and the action decoder: `l2` or `l1`.
        shift: shift of frames in the latent policy's training, pixels.
        model: training of inverse and forward model.
        policy: training of the latent policy.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest is as for the policy.
        world: another run of LAPO whose inverse and forward model are taken; empty trains them on `data.root`.
    """

    channels: tuple[int, ...] = (64, 128, 128)
    hidden: int = 256
    groups: int = 8
    code_dim: int = 16
    codes: int = 64
    decay: float = 0.99
    dead_threshold: float = 1.0
    commitment: float = 0.05
    loss: Literal["l2", "l1"] = "l2"
    shift: int = 0
    model: StageConfig = field(default_factory=lambda: _stage(200_000, 3e-4, "cosine"))
    policy: StageConfig = field(default_factory=lambda: _stage(20_000, 2e-4, "constant"))
    decoder_steps: int = 20_000
    decoder_lr: float = 2e-4
    world: str = ""

    def __post_init__(self) -> None:
        check(1 <= len(self.channels) <= 5, "baselines.lapo.channels", self.channels, "1 to 5 widths")
        check(self.groups >= 1, "baselines.lapo.groups", self.groups, "at least 1")
        check(self.codes >= 2, "baselines.lapo.codes", self.codes, "at least 2")
        check(0.0 < self.decay < 1.0, "baselines.lapo.decay", self.decay, "a number in (0, 1)")
        check(0 <= self.shift <= 16, "baselines.lapo.shift", self.shift, "0 to 16 pixels")
        check(self.decoder_steps >= 1, "baselines.lapo.decoder_steps", self.decoder_steps, "at least 1")

    @property
    def latent_dim(self) -> int:
        """Z = G times the width of a code."""
        return self.groups * self.code_dim
