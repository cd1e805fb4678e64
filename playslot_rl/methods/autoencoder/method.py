"""A convolutional autoencoder of single frames on unlabelled videos, then a policy on its frozen features that clones
the labelled demonstrations alone; its settings.

What Slot BC is without slots: ResNet BC starts from scratch, SAVi has seen all videos. Ours; no paper has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, Checked, between, role
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import StageConfig, clipped_stage


@dataclass(frozen=True)
class AutoencoderBCConfig(Checked):
    """Sizes and schedule; the policy's sizes are `model.policy`, its loss `behaviour.loss`.

    Attributes:
        channels: of the encoder's levels, each of which halves the resolution; the decoder mirrors them.
        code_dim: width of the code at each place of the last level, a token of the policy.
        shift: shift of frames in the policy's training, pixels.
        model: training of the autoencoder.
        policy: training of the policy.
        world: another run whose autoencoder is taken; empty trains one on `data.root`.
    """

    group = "baselines.autoencoder_bc."
    channels: tuple[int, ...] = field(default=(64, 128, 128, 128), metadata=COUNT)
    code_dim: int = field(default=64, metadata=COUNT)
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    model: StageConfig = field(default_factory=lambda: clipped_stage(200_000, 3e-4, "cosine"))
    policy: StageConfig = field(default_factory=lambda: clipped_stage(20_000, 2e-4, "constant"))
    world: str = field(default="", metadata=role("machine", "folder"))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(1 <= len(self.channels) <= 5, "baselines.autoencoder_bc.channels", self.channels, "1 to 5 widths")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        for part, stage in (("model", self.model), ("policy", self.policy)):
            yield windows(f"{name}.{part}", stage, frame_numbers(config))
        weights = 45 * chain(3, *self.channels) + 2 * self.channels[-1] * self.code_dim
        yield Need((name,), "the autoencoder's weights", weights * WEIGHT)


NAME: Final = "autoencoder_bc"
_BUILT: Final = tuple(f"baselines.{NAME}.{key}" for key in ("channels", "code_dim"))
MODEL: Final = StageSpec(
    "autoencoder", keys=_BUILT, settings=(f"baselines.{NAME}.model",), stores=("model",),
    parts="playslot_rl.methods.autoencoder.training:model", title="an autoencoder of frames",
)  # fmt: skip
POLICY: Final = StageSpec(
    NAME,
    keys=(
        "model.policy", "behaviour.loss", "behaviour.trim_pixels", "behaviour.trim_margin", *_BUILT,
        f"baselines.{NAME}.shift",
    ),
    settings=(f"baselines.{NAME}.policy",),
    parents=("autoencoder",),
    data="labelled",
    parts="playslot_rl.methods.autoencoder.training:policy",
)  # fmt: skip
AUTOENCODER_BC: Final = Method(
    NAME,
    ("Autoencoder BC",),
    Style(3, "8"),
    AutoencoderBCConfig,
    (MODEL, POLICY),
    Load(actor="playslot_rl.methods.autoencoder.network:load_actor"),
)
