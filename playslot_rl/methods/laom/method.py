"""LAOM: a latent-action model that labels supervise, then a latent policy and an action decoder; its settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.pretraining import PretrainedConfig
from playslot_rl.config.roles import COUNT, NOT_NEGATIVE, OPEN_FRACTION, RATE, at_least, between
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import DECODING, StageConfig, clipped_stage


@dataclass(frozen=True)
class LAOMConfig(PretrainedConfig):
    """Sizes and schedule of LAOM, whose decoder is as LAPO's.

    Attributes:
        channels: of the encoders; each halves the resolution.
        hidden: width of layers.
        latent_dim: of latent actions.
        offset: most steps that the inverse model looks ahead.
        jitter: shift of a transition's frames, pixels; without it latents fall into few directions.
        target_rate: part of the encoder that its slow copy takes in a step.
        label_weight: of the labelled actions in the model's loss; 0 does not read them.
        loss: of policy and decoder, `l2` or `l1`.
        decoder_steps: of the action decoder.
        decoder_lr: its learning rate.
    """

    group = "baselines.laom."
    encoder: ClassVar[Literal["strided"]] = "strided"
    channels: tuple[int, ...] = field(default=(96, 192, 192), metadata=COUNT)
    hidden: int = field(default=1024, metadata=COUNT)
    latent_dim: int = field(default=8192, metadata=COUNT)
    offset: int = field(default=10, metadata=COUNT)
    jitter: int = field(default=4, metadata=between(0, 16, "0 to 16 pixels"))
    target_rate: float = field(default=0.001, metadata=OPEN_FRACTION)
    label_weight: float = field(default=0.1, metadata=NOT_NEGATIVE)
    loss: Literal["l2", "l1"] = "l2"
    model: StageConfig = field(default_factory=lambda: clipped_stage(200_000, 1e-4, "cosine"))
    policy: StageConfig = field(default_factory=lambda: clipped_stage(20_000, 1e-4, "constant"))
    decoder_steps: int = field(default=20_000, metadata=at_least(1))
    decoder_lr: float = field(default=3e-4, metadata=RATE)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_levels(self.channels)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield from super().needs(name, config)
        weights = 9 * chain(3, *self.channels) + self.hidden * (24 * self.hidden + 4 * self.latent_dim)
        yield Need((name,), "LAOM's weights", weights * WEIGHT)


NAME: Final = "laom"
_BUILT: Final = tuple(
    f"baselines.laom.{key}"
    for key in ("channels", "hidden", "latent_dim", "offset", "jitter", "target_rate", "label_weight")
)
_TRIMS: Final = ("behaviour.trim_pixels", "behaviour.trim_margin")
MODEL: Final = StageSpec(
    "laom_model",
    keys=(*_BUILT, *_TRIMS),
    settings=("baselines.laom.model",),
    labels="baselines.laom.label_weight",
    stores=("model",),
    parts="playslot_rl.methods.laom.training:model",
    title="LAOM's latent-action model",
)
POLICY: Final = StageSpec(
    NAME,
    keys=("model.action_decoder", *_TRIMS, *_BUILT, "baselines.laom.loss", "baselines.laom.shift"),
    settings=(
        *DECODING, "baselines.laom.policy", "baselines.laom.decoder_steps", "baselines.laom.decoder_lr",
    ),
    parents=("laom_model",),
    data="demos",
    parts="playslot_rl.methods.laom.training:policy",
    also=("behaviour.policy_from",),
    sizes="playslot_rl.methods.cloning:sizes",
)  # fmt: skip
LAOM: Final = Method(
    NAME, ("LAOM",), Style(5, "H"), LAOMConfig, (MODEL, POLICY),
    Load(actor="playslot_rl.methods.laom.model:load_actor"), told="task",
)  # fmt: skip
