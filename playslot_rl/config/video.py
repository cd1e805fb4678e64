"""Config of the video predictors that PlaySlot is compared with (paper, Table 1), one class a method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.model import PredictorConfig
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, LAYERS, NOT_NEGATIVE, OPEN_FRACTION, above_zero, at_least, role, was
from playslot_rl.config.stages import DynamicsStageConfig, OptimConfig, StageConfig


@dataclass(frozen=True)
class VideoStageConfig(StageConfig):
    """Clips and training of a video predictor.

    Attributes:
        seed_frames: frames that are shown.
        predicted_frames: frames predicted after them.
        decoded_frames: of a clip's predictions, how many are decoded for the image loss, drawn at random; 0 decodes
            all of them.
    """

    seed_frames: int = field(default=6, metadata=at_least(1))
    predicted_frames: int = field(default=8, metadata=at_least(1))
    decoded_frames: int = field(default=0, metadata=NOT_NEGATIVE)


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


@dataclass(frozen=True)
class SlotFormerSizes(PredictorConfig):
    """SlotFormer at the paper's size: queries, keys and values without bias, heads without an output projection."""

    group = "baselines.slotformer.predictor."
    kind: Literal["cocvp", "ocvp_seq", "slotformer"] = "slotformer"
    head_dim: int = field(default=32, metadata=COUNT)
    residual: bool = True
    context: int = field(default=6, metadata=at_least(2, "at least 2 frames"))
    project_out: bool = field(default=False, metadata=was(True))


@dataclass(frozen=True)
class OCVPSeqSizes(PredictorConfig):
    """OCVP-Seq at the paper's size, likewise: two blocks a layer, each with an MLP of 512."""

    group = "baselines.ocvp_seq.predictor."
    kind: Literal["cocvp", "ocvp_seq", "slotformer"] = "ocvp_seq"
    head_dim: int = field(default=32, metadata=COUNT)
    mlp_dim: int = field(default=512, metadata=COUNT)
    residual: bool = True
    project_out: bool = field(default=False, metadata=was(True))


@dataclass(frozen=True)
class SlotFormerConfig(DynamicsStageConfig):
    """SlotFormer on a frozen SAVi's slots: stage 2 with nothing inferred.

    Attributes:
        predictor: sizes.
    """

    group = "baselines.slotformer."
    predictor: SlotFormerSizes = field(default_factory=SlotFormerSizes)


@dataclass(frozen=True)
class OCVPSeqConfig(DynamicsStageConfig):
    """OCVP-Seq on a frozen SAVi's slots: stage 2 with nothing inferred.

    Attributes:
        predictor: sizes.
    """

    group = "baselines.ocvp_seq."
    predictor: OCVPSeqSizes = field(default_factory=OCVPSeqSizes)
