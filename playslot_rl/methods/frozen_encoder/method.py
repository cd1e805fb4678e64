"""An encoder of single frames that learns from unlabelled videos, then a policy on its frozen code that clones the
labelled demonstrations alone; their settings.

What Slot BC is without slots: ResNet BC starts from scratch, SAVi has seen all videos. **Autoencoder BC** is ours; no
paper has it. **Inverse BC** has a ResNet-18 trained by latent inverse dynamics, as DynaMo (Cui et al., 2024).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import WEIGHT, Need, chain
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.pretraining import PretrainedConfig
from playslot_rl.config.roles import COUNT
from playslot_rl.config.stage_spec import StageSpec


@dataclass(frozen=True)
class EncoderBCConfig(PretrainedConfig):
    """What both have; the policy's sizes are `model.policy`, its loss `behaviour.loss`."""

    @property
    def code(self) -> tuple[int, int]:
        """Width of the code at each place of the encoder's last level, and how many levels halve the resolution."""
        raise NotImplementedError


@dataclass(frozen=True)
class AutoencoderBCConfig(EncoderBCConfig):
    """Sizes of the autoencoder.

    Attributes:
        channels: of the encoder's levels, each of which halves the resolution; the decoder mirrors them.
        code_dim: width of the code at each place of the last level, a token of the policy.
    """

    group = "baselines.autoencoder_bc."
    channels: tuple[int, ...] = field(default=(64, 128, 128, 128), metadata=COUNT)
    code_dim: int = field(default=64, metadata=COUNT)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_levels(self.channels)

    @property
    def code(self) -> tuple[int, int]:
        return self.code_dim, len(self.channels)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield from super().needs(name, config)
        weights = 45 * chain(3, *self.channels) + 2 * self.channels[-1] * self.code_dim
        yield Need((name,), "the autoencoder's weights", weights * WEIGHT)


@dataclass(frozen=True)
class InverseBCConfig(EncoderBCConfig):
    """Sizes of what a ResNet-18 is trained with.

    Attributes:
        channels: of the forward model's U-Net, each of which halves the resolution.
        hidden: width of the layer between the ResNet's features and the latent action.
        latent_dim: of latent actions.
    """

    group = "baselines.inverse_bc."
    channels: tuple[int, ...] = field(default=(64, 128, 128), metadata=COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    latent_dim: int = field(default=8, metadata=COUNT)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_levels(self.channels)

    @property
    def code(self) -> tuple[int, int]:
        return 512, 5

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield from super().needs(name, config)
        width, levels = self.code
        places = (config.env.image_size // 2**levels) ** 2
        weights = 9 * chain(3, *self.channels) + self.hidden * (2 * places * width + self.latent_dim)
        yield Need((name,), "the inverse model's weights", weights * WEIGHT)


_PARTS: Final = "playslot_rl.methods.frozen_encoder.training"
_SHARED: Final = ("model.policy", "behaviour.loss", "behaviour.trim_pixels", "behaviour.trim_margin")


def _method(
    name: str, title: str, style: Style, config: type[EncoderBCConfig], sizes: tuple[str, ...], model: tuple[str, str]
) -> Method:
    """Model, by its stage's name and in words, and policy."""
    own, (stage, words) = f"baselines.{name}", model
    built = tuple(f"{own}.{key}" for key in sizes)
    parts = (
        StageSpec(
            stage, keys=built, settings=(f"{own}.model",), stores=("model",), parts=f"{_PARTS}:model", title=words
        ),
        StageSpec(
            name,
            keys=(*_SHARED, *built, f"{own}.shift"),
            settings=(f"{own}.policy",),
            parents=(stage,),
            data="labelled",
            parts=f"{_PARTS}:policy",
        ),
    )
    return Method(
        name, (title,), style, config, parts,
        Load(actor=f"playslot_rl.methods.frozen_encoder.network:load_{stage}"), told="task",
    )  # fmt: skip


AUTOENCODER_BC: Final = _method(
    "autoencoder_bc", "Autoencoder BC", Style(3, "8"), AutoencoderBCConfig, ("channels", "code_dim"),
    ("autoencoder", "an autoencoder of frames"),
)  # fmt: skip
INVERSE_BC: Final = _method(
    "inverse_bc", "Inverse BC", Style(3, "$I$"), InverseBCConfig, ("channels", "hidden", "latent_dim"),
    ("inverse_resnet", "a ResNet-18 by latent inverse dynamics"),
)  # fmt: skip
