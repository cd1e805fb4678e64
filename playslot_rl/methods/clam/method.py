"""CLAM: inverse and forward model and action decoder together, then a latent policy; its settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.pretraining import PretrainedConfig
from playslot_rl.config.roles import COUNT, above_zero
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import StageConfig, clipped_stage


@dataclass(frozen=True)
class CLAMConfig(PretrainedConfig):
    """Sizes and schedule of CLAM.

    Attributes:
        channels: of the encoders; each halves the resolution.
        hidden: width of layers.
        latent_dim: of latent actions.
        label_weight: of the labelled actions in the model's loss.
        loss: of the policy, `l2` or `l1`.
    """

    group = "baselines.clam."
    encoder: ClassVar[Literal["strided"]] = "strided"
    channels: tuple[int, ...] = field(default=(64, 128, 128), metadata=COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    latent_dim: int = field(default=8, metadata=COUNT)
    label_weight: float = field(default=1.0, metadata=above_zero())
    loss: Literal["l2", "l1"] = "l2"
    policy: StageConfig = field(default_factory=lambda: clipped_stage(100_000, 3e-4, "constant"))

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_levels(self.channels)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield from super().needs(name, config)
        weights = 9 * chain(9, *self.channels) + self.hidden * (self.channels[-1] + self.latent_dim)
        yield Need((name,), "CLAM's weights", weights * WEIGHT)


NAME: Final = "clam"
_BUILT: Final = tuple(f"baselines.clam.{key}" for key in ("channels", "hidden", "latent_dim", "label_weight"))
_SHARED: Final = ("model.action_decoder", "behaviour.trim_pixels", "behaviour.trim_margin", *_BUILT)
MODEL: Final = StageSpec(
    "clam_model",
    keys=_SHARED,
    settings=("baselines.clam.model",),
    labels="baselines.clam.label_weight",
    parts="playslot_rl.methods.clam.training:model",
    title="CLAM's model and decoder",
)
POLICY: Final = StageSpec(
    NAME,
    keys=(*_SHARED, "baselines.clam.loss", "baselines.clam.shift"),
    settings=("behaviour.labelled_demos", "baselines.clam.policy"),
    parents=("clam_model",),
    data="demos",
    parts="playslot_rl.methods.clam.training:policy",
)
CLAM: Final = Method(
    NAME, ("CLAM",), Style(5, "*"), CLAMConfig, (MODEL, POLICY),
    Load(actor="playslot_rl.methods.clam.model:load_actor"), told="task",
)  # fmt: skip
