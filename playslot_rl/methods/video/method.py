"""SlotFormer and OCVP-Seq on the slots of a frozen SAVi, with nothing inferred."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import Need, predictor_weights, rollouts
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.model import PredictorConfig
from playslot_rl.config.roles import COUNT, NOT_NEGATIVE, at_least, was
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import DynamicsStageConfig, StageConfig


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

    @property
    def frames(self) -> int:
        return self.seed_frames + self.predicted_frames


@dataclass(frozen=True)
class OnSlotsConfig(DynamicsStageConfig):
    """Stage 2 with nothing inferred, on a frozen SAVi's slots.

    Attributes:
        predictor: sizes.
    """

    predictor: PredictorConfig = field(default_factory=PredictorConfig)

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        yield rollouts(name, self, config)
        yield predictor_weights(f"{name}.predictor", self.predictor, config)


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
class SlotFormerConfig(OnSlotsConfig):
    """SlotFormer on a frozen SAVi's slots: stage 2 with nothing inferred.

    Attributes:
        predictor: sizes.
    """

    group = "baselines.slotformer."
    predictor: SlotFormerSizes = field(default_factory=SlotFormerSizes)


@dataclass(frozen=True)
class OCVPSeqSizes(PredictorConfig):
    """OCVP-Seq at the paper's size, queries, keys and values without bias, heads without an output projection: two
    blocks a layer, each with an MLP of 512.
    """

    group = "baselines.ocvp_seq.predictor."
    kind: Literal["cocvp", "ocvp_seq", "slotformer"] = "ocvp_seq"
    head_dim: int = field(default=32, metadata=COUNT)
    mlp_dim: int = field(default=512, metadata=COUNT)
    residual: bool = True
    project_out: bool = field(default=False, metadata=was(True))


@dataclass(frozen=True)
class OCVPSeqConfig(OnSlotsConfig):
    """OCVP-Seq on a frozen SAVi's slots: stage 2 with nothing inferred.

    Attributes:
        predictor: sizes.
    """

    group = "baselines.ocvp_seq."
    predictor: OCVPSeqSizes = field(default_factory=OCVPSeqSizes)


def _method(name: str, titles: tuple[str, ...], style: Style, config: type[OnSlotsConfig]) -> Method:
    stage = StageSpec(
        name,
        keys=("env.image_size", "model.savi"),
        settings=(f"baselines.{name}",),
        parents=("slots",),
        parts="playslot_rl.methods.video.training:training",
        sizes="playslot_rl.methods.video.training:uncontrolled",
    )
    return Method(name, titles, style, config, (stage,), Load(video=f"playslot_rl.methods.video.training:{name}"))


SLOTFORMER: Final = _method("slotformer", ("SlotFormer",), Style(2, "^"), SlotFormerConfig)
OCVP_SEQ: Final = _method("ocvp_seq", ("OCVP-Seq", "OCVP"), Style(3, "D"), OCVPSeqConfig)
