"""LAPO: inverse and forward model on videos, then a latent policy and an action decoder; its settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, NOT_NEGATIVE, OPEN_FRACTION, RATE, Checked, at_least, between, role, was
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import DECODING, OptimConfig, StageConfig
from playslot_rl.errors import ConfigError

Encoder = Literal["impala", "strided"]
Targets = Literal["continuous", "quantised"]


@dataclass(frozen=True)
class LatentConfig(Checked):
    """Latent actions, on frames or on slots.

    Attributes:
        frames: that the inverse model sees; the forward model sees all but the last.
        groups: G codes that make up a latent action.
        codebooks: that groups share equally.
        code_dim: width of each, so that a latent action has `groups * code_dim` numbers.
        codes: K entries of a codebook.
        decay: of the codebooks' moving averages.
        dead_threshold: EMA cluster size under which a code is revived.
        commitment: weight beta of the commitment term.
        targets: latents that policy and decoder learn from, `continuous` (before quantisation, as LAPO's code) or
            `quantised`.
        model: training of inverse and forward model.
        world: another run of the method whose inverse and forward model are taken; empty trains them on `data.root`.
    """

    frames: int = field(default=3, metadata=was(2) | between(2, 3, "2 or 3"))
    groups: int = field(default=8, metadata=at_least(1))
    codebooks: int = field(default=2, metadata=was(1) | at_least(1))
    code_dim: int = field(default=16, metadata=COUNT)
    codes: int = field(default=64, metadata=at_least(2))
    decay: float = field(default=0.999, metadata=OPEN_FRACTION)
    dead_threshold: float = field(default=1.0, metadata=NOT_NEGATIVE)
    commitment: float = field(default=0.05, metadata=NOT_NEGATIVE)
    targets: Targets = field(default="continuous", metadata=was("quantised"))
    model: StageConfig = field(default_factory=lambda: _stage(50_000, 3e-4, 50, 2.0))
    world: str = field(default="", metadata=role("machine", "folder"))

    def __post_init__(self) -> None:
        super().__post_init__()
        books = f"a divisor of groups {self.groups}"
        check(self.groups % self.codebooks == 0, f"{self.group}codebooks", self.codebooks, books)

    @property
    def latent_dim(self) -> int:
        """Z = G times the width of a code."""
        return self.groups * self.code_dim


@dataclass(frozen=True)
class LAPOConfig(LatentConfig):
    """Sizes and schedule of LAPO. The action decoder's size is `model.action_decoder`; inputs, state, labels and
    fine-tuning are `behaviour`'s, as for PlaySlot.

    Attributes:
        encoder: `impala`, or `strided`, which is quicker.
        channels: of the encoders; each halves the resolution.
        forward_channels: of the forward model's U-Net; none: `channels`.
        hidden: width of the layer between an encoder and its output.
        loss: of the latent policy and the action decoder: `l2` or `l1`.
        shift: shift of frames in the latent policy's training, pixels.
        policy: training of the latent policy.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest is as for the policy.
    """

    group = "baselines.lapo."
    encoder: Encoder = field(default="impala", metadata=was("strided"))
    channels: tuple[int, ...] = field(default=(64, 128, 128), metadata=COUNT)
    forward_channels: tuple[int, ...] = field(default=(24, 48, 96, 192, 384, 768), metadata=was(()) | COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    loss: Literal["l2", "l1"] = "l2"
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    policy: StageConfig = field(default_factory=lambda: _stage(60_000, 2e-4, 1000, 0.0))
    decoder_steps: int = field(default=20_000, metadata=at_least(1))
    decoder_lr: float = field(default=2e-4, metadata=RATE)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(1 <= len(self.channels) <= 6, "baselines.lapo.channels", self.channels, "1 to 6 widths")

    def check(self, name: str, config: ExperimentConfig) -> None:
        """Refuse more halvings than frames have, by a ConfigError."""
        size = config.env.image_size
        for key in ("channels", "forward_channels"):
            widths: tuple[int, ...] = getattr(self, key)
            if size % 2 ** len(widths):
                raise ConfigError(
                    f"{name}.{key}: got {len(widths)} widths, each of which halves frames of env.image_size={size}, "
                    "expected fewer: name those alone that fit"
                )

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        for part, stage in (("model", self.model), ("policy", self.policy)):
            yield windows(f"{name}.{part}", stage, frame_numbers(config))
        weights = 9 * (chain(3, *self.channels) + chain(3, *self.forward_channels))
        weights += self.hidden * (self.channels[-1] + self.latent_dim)
        yield Need((name,), "LAPO's weights", (weights + self.codes * self.code_dim) * WEIGHT)


def _stage(steps: int, lr: float, warmup: int, clip: float) -> StageConfig:
    """As the published code; its rates fall linearly."""
    optim = OptimConfig(lr=lr, warmup_steps=warmup, schedule="cosine", grad_clip=clip)
    return StageConfig(steps=steps, batch_size=128, optim=optim)


NAME: Final = "lapo"
QUANTISED: Final = ("frames", "groups", "codebooks", "code_dim", "codes", "decay", "dead_threshold", "commitment")
SIZES: Final = ("encoder", "channels", "forward_channels", "hidden", *QUANTISED)
"""Settings that inverse and forward model are built from."""
_BUILT: Final = tuple(f"baselines.lapo.{key}" for key in SIZES)
MODEL: Final = StageSpec(
    "lapo_model", keys=_BUILT, settings=("baselines.lapo.model",), stores=("model",),
    parts="playslot_rl.methods.lapo.training:model", title="LAPO's inverse and forward model",
)  # fmt: skip
POLICY: Final = StageSpec(
    NAME,
    keys=(
        "model.action_decoder", "behaviour.trim_pixels", "behaviour.trim_margin", *_BUILT, "baselines.lapo.loss",
        "baselines.lapo.targets", "baselines.lapo.shift",
    ),
    settings=(
        *DECODING, "baselines.lapo.policy", "baselines.lapo.decoder_steps", "baselines.lapo.decoder_lr",
    ),
    parents=("lapo_model",),
    data="demos",
    parts="playslot_rl.methods.lapo.training:policy",
    also=("behaviour.policy_from",),
    sizes="playslot_rl.methods.cloning:sizes",
    begun_names={
        "model.action_decoder": "action_decoder",
        "behaviour.trim_pixels": "trim_pixels",
        "behaviour.trim_margin": "trim_margin",
        "baselines.lapo.loss": "loss",
        "baselines.lapo.targets": "targets",
        "baselines.lapo.shift": "shift",
    },
)  # fmt: skip
LAPO: Final = Method(
    NAME, ("LAPO",), Style(5, "s"), LAPOConfig, (MODEL, POLICY),
    Load(actor="playslot_rl.methods.lapo.model:load_actor"), told="task",
)  # fmt: skip
