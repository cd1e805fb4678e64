"""OCVP-Seq on the slots of a frozen SAVi, with nothing inferred."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "ocvp_seq"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.savi"),
    settings=("baselines.ocvp_seq",),
    parents=("slots",),
)
