"""Settings of SlotFormer (`baselines.slotformer`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.model import PredictorConfig
from playslot_rl.config.roles import COUNT, at_least, was
from playslot_rl.methods.video.config import OnSlotsConfig


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
