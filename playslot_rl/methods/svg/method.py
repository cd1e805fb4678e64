"""SVG-LP: frames predicted from latents that are inferred, or drawn from a learned prior; its settings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain, frame_numbers, windows
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, LAYERS, NOT_NEGATIVE, at_least
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import OptimConfig
from playslot_rl.methods.video.method import VideoStageConfig


@dataclass(frozen=True)
class SVGConfig(VideoStageConfig):
    """SVG-LP (Denton and Fergus, 2018).

    Attributes:
        channels: of the groups of 3x3 convolutions, each followed by a halving of the resolution, to 4x4 in the end.
        convs: convolutions in each group.
        features: width of a frame's code h.
        latent_dim: Z.
        hidden: width of the LSTMs.
        layers: cells of the frame predictor's LSTM; posterior and prior have one.
        kl_weight: beta, of the divergence between posterior and learned prior.
    """

    group = "baselines.svg."
    steps: int = field(default=180_000, metadata=at_least(1))
    batch_size: int = field(default=100, metadata=at_least(1))
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=2e-3, warmup_steps=0, schedule="constant", grad_clip=0.0)
    )
    channels: tuple[int, ...] = field(default=(64, 128, 256, 512), metadata=COUNT)
    convs: tuple[int, ...] = field(default=(2, 2, 3, 3), metadata=LAYERS)
    features: int = field(default=128, metadata=COUNT)
    latent_dim: int = field(default=64, metadata=COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    layers: int = field(default=2, metadata=LAYERS)
    kl_weight: float = field(default=1e-4, metadata=NOT_NEGATIVE)

    def __post_init__(self) -> None:
        super().__post_init__()
        known = len(self.channels)
        check(2 <= known <= 5, "baselines.svg.channels", self.channels, "2 to 5 widths")
        check(len(self.convs) == known, "baselines.svg.convs", self.convs, f"one number for each of {known} widths")
        check(min(self.convs) >= 1, "baselines.svg.convs", self.convs, "numbers of at least 1")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield windows(name, self, self.frames * frame_numbers(config))
        weights = 9 * chain(3, *self.channels) + self.features * self.channels[-1]
        weights += self.hidden * (self.features + self.latent_dim) + 8 * self.layers * self.hidden**2
        yield Need((name,), "SVG's weights", weights * WEIGHT)

    def check(self, name: str, config: ExperimentConfig) -> None:
        from playslot_rl.methods.svg.model import SVG
        from playslot_rl.methods.video.training import check_pixel_model

        check_pixel_model(SVG, config, name.rpartition(".")[2])


NAME: Final = "svg"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.policy"),
    settings=("baselines.svg",),
    parts="playslot_rl.methods.svg.training:training",
)
SVG: Final = Method(
    NAME,
    ("SVG-LP", "SVG"),
    Style(1, "v"),
    SVGConfig,
    (STAGE,),
    Load(video="playslot_rl.methods.svg.training:load_video"),
)
