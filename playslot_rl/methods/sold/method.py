"""SOLD learns by acting, on the slots of a finished SAVi."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.sold.config import SOLDConfig

NAME: Final = "sold"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.sold",),
    begun=("render",),
    parents=("slots",),
    data="",
    parts="playslot_rl.methods.sold.training:training",
)
SOLD: Final = Method(
    NAME,
    ("SOLD",),
    Style(4, "P"),
    SOLDConfig,
    (STAGE,),
    Load(actor="playslot_rl.methods.sold.actor:load_actor"),
)
