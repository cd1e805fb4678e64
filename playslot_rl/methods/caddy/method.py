"""CADDY: a video model with discrete actions, a policy that clones them, and an oracle on its states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import (
    COUNT,
    NOT_NEGATIVE,
    OPEN_FRACTION,
    RATE,
    Checked,
    above_zero,
    at_least,
    between,
    role,
)
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import DECODING, OptimConfig, StageConfig, clipped_stage
from playslot_rl.methods.video.method import VideoStageConfig


@dataclass(frozen=True)
class CADDYConfig(VideoStageConfig):
    """CADDY (Menapace et al., 2021).

    Attributes:
        encoder: channels of the encoder's stem and of its three widths.
        dynamics: channels of the recurrent part; the middle one, at half the resolution, has twice as many.
        generator: channels of the generator at 16x16, 32x32 and 64x64.
        actions: K.
        latent_dim: Z, of an action's direction and of its variability.
        perceptual: weights of VGG19 for the perceptual loss: empty goes without it, `auto` takes torch's cache where it
            has them, else a path (`.pth` as torchvision publishes it, or `.safetensors` with the same names).
        perceptual_weight, state_weight, kl_weight, information_weight: of the loss's terms.
        information_decay: of the moving average of the joint distribution of actions, real against generated.
        centroid_decay: of the moving average of the actions' centroids.
        warmup_steps: first steps, in which the generator learns to reconstruct and the recurrent part its states.
        temperature: of the Gumbel-softmax, at the start and at the end of `anneal_steps`.
        anneal_steps: in which it falls.
        first_frames: length of a clip at the start; it grows to seed and predicted frames over `growth_steps`.
        growth_steps: in which it grows.
        variability: v at test: inferred from the true future (`inferred`), or `zero`.
    """

    group = "baselines.caddy."
    steps: int = field(default=300_000, metadata=at_least(1))
    batch_size: int = field(default=8, metadata=at_least(1))
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=4e-4, warmup_steps=0, schedule="constant", grad_clip=0.0)
    )
    encoder: tuple[int, ...] = field(default=(16, 16, 32, 64), metadata=COUNT)
    dynamics: int = field(default=128, metadata=COUNT)
    generator: tuple[int, ...] = field(default=(128, 64, 32), metadata=COUNT)
    actions: int = field(default=8, metadata=at_least(2))
    latent_dim: int = field(default=8, metadata=COUNT)
    perceptual: str = field(default="", metadata=role("folder"))
    perceptual_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    state_weight: float = field(default=0.2, metadata=NOT_NEGATIVE)
    kl_weight: float = field(default=1e-4, metadata=NOT_NEGATIVE)
    information_weight: float = field(default=0.15, metadata=NOT_NEGATIVE)
    information_decay: float = field(default=0.8, metadata=OPEN_FRACTION)
    centroid_decay: float = field(default=0.9, metadata=OPEN_FRACTION)
    warmup_steps: int = field(default=1000, metadata=NOT_NEGATIVE)
    temperature: tuple[float, float] = field(default=(1.0, 0.4), metadata=above_zero())
    anneal_steps: int = field(default=20_000, metadata=at_least(1))
    first_frames: int = field(default=7, metadata=at_least(2))
    growth_steps: int = field(default=25_000, metadata=NOT_NEGATIVE)
    variability: Literal["inferred", "zero"] = "inferred"

    def __post_init__(self) -> None:
        super().__post_init__()
        check(len(self.encoder) == 4, "baselines.caddy.encoder", self.encoder, "four widths")
        check(len(self.generator) == 3, "baselines.caddy.generator", self.generator, "three widths")
        check(len(self.temperature) == 2, "baselines.caddy.temperature", self.temperature, "two numbers above 0")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, self.frames * frame_numbers(config))
        weights = 9 * (chain(3, *self.encoder) + chain(self.dynamics, *self.generator)) + 9 * self.dynamics**2
        weights += self.actions * (self.latent_dim + self.dynamics)
        yield Need((name,), "CADDY's weights", weights * WEIGHT)

    def check(self, name: str, config: ExperimentConfig) -> None:
        from playslot_rl.methods.caddy.model import CADDY
        from playslot_rl.methods.caddy.stage import load_perceptual
        from playslot_rl.methods.video.training import check_pixel_model

        check_pixel_model(CADDY, config, name.rpartition(".")[2])
        load_perceptual(self.perceptual)


@dataclass(frozen=True)
class CADDYOracleConfig(Checked):
    """Schedule of a policy on CADDY's states: the CADDY Oracle's whole one. The model is `baselines.caddy`, the loss
    `behaviour.loss`.

    Attributes:
        shift: shift of frames in training, pixels.
        policy: training of the policy.
        world: run whose CADDY is taken; empty trains one on `data.root`.
    """

    group = "baselines.caddy_oracle."
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    policy: StageConfig = field(default_factory=lambda: clipped_stage(20_000, 2e-4, "constant"))
    world: str = field(default="", metadata=role("machine", "folder"))

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(f"{name}.policy", self.policy, frame_numbers(config))


@dataclass(frozen=True)
class CADDYPolicyConfig(CADDYOracleConfig):
    """Schedule of CADDY's policy and of its action decoder, whose size is `model.action_decoder`; inputs, state, labels
    and fine-tuning are `behaviour`'s, as for PlaySlot.

    Attributes:
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest is as for the policy.
    """

    group = "baselines.caddy_policy."
    decoder_steps: int = field(default=20_000, metadata=at_least(1))
    decoder_lr: float = field(default=2e-4, metadata=RATE)


MODEL: Final = StageSpec(
    "caddy",
    keys=("env.image_size", "model.policy"),
    settings=("baselines.caddy",),
    parts="playslot_rl.methods.caddy.behaviour:model",
    title="CADDY's video model",
)
_TRIMS: Final = ("behaviour.trim_pixels", "behaviour.trim_margin")
POLICY: Final = StageSpec(
    "caddy_policy",
    keys=("model.action_decoder", "behaviour.loss", *_TRIMS, "baselines.caddy_policy.shift"),
    settings=(*DECODING, "baselines.caddy_policy"),
    parents=("caddy",),
    data="demos",
    parts="playslot_rl.methods.caddy.behaviour:policy",
    also=("behaviour.policy_from",),
    sizes="playslot_rl.methods.cloning:sizes",
    begun_names={
        "behaviour.trim_pixels": "trim_pixels",
        "behaviour.trim_margin": "trim_margin",
        "baselines.caddy_policy.shift": "shift",
    },
)
ORACLE: Final = StageSpec(
    "caddy_oracle",
    keys=("behaviour.loss", *_TRIMS, "baselines.caddy_oracle.shift"),
    settings=("baselines.caddy_oracle",),
    parents=("caddy",),
    data="demos",
    parts="playslot_rl.methods.caddy.behaviour:oracle",
)
_LOADED: Final = "playslot_rl.methods.caddy.heads"
CADDY: Final = Method("caddy", ("CADDY",), Style(5, "s"), CADDYConfig, (MODEL,), Load(video=f"{_LOADED}:load_video"))
CADDY_POLICY: Final = Method(
    "caddy_policy", ("CADDY",), Style(6, "X"), CADDYPolicyConfig, (MODEL, POLICY),
    Load(actor=f"{_LOADED}:load_policy"), told="task",
)  # fmt: skip
CADDY_ORACLE: Final = Method(
    "caddy_oracle",
    ("CADDY Oracle",),
    Style(7, "p"),
    CADDYOracleConfig,
    (MODEL, ORACLE),
    Load(actor=f"{_LOADED}:load_oracle"),
    told="task",
)
