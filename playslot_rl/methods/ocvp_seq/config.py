"""Settings of OCVP-Seq (`baselines.ocvp_seq`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.model import PredictorConfig
from playslot_rl.config.roles import COUNT, was
from playslot_rl.methods.video.config import OnSlotsConfig


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
