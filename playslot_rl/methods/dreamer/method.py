"""DreamerV3 learns by acting, from pixels."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "dreamer"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.dreamer",),
    begun=("render",),
    data="",
)
