"""The ResNet oracle: a ResNet-18 on the real actions of all demonstrations."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "resnet_oracle"
STAGE: Final = StageSpec(
    NAME,
    keys=("model.policy", "behaviour.loss", "behaviour.trim_pixels", "behaviour.trim_margin"),
    settings=("baselines.resnet_oracle",),
    data="demos",
)
