"""DreamerV3 learns by acting, from pixels."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.dreamer.config import DreamerConfig

NAME: Final = "dreamer"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.dreamer",),
    begun=("render",),
    data="",
    parts="playslot_rl.methods.dreamer.training:training",
)
DREAMER: Final = Method(
    NAME,
    ("DreamerV3",),
    Style(3, "D"),
    DreamerConfig,
    (STAGE,),
    Load(actor="playslot_rl.methods.dreamer.actor:load_actor"),
)
