"""SlotFormer on the slots of a frozen SAVi, with nothing inferred."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "slotformer"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.savi"),
    settings=("baselines.slotformer",),
    parents=("slots",),
)
