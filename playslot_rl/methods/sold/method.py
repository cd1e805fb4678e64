"""SOLD learns by acting, on the slots of a finished SAVi."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "sold"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.sold",),
    begun=("render",),
    parents=("slots",),
    data="",
)
