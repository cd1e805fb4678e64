"""A ResNet-18 on the real actions of all demonstrations, or of the labelled ones alone (BC)."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.resnet_oracle.config import ResNetOracleConfig

NAME: Final = "resnet_oracle"
STAGE: Final = StageSpec(
    NAME,
    keys=("model.policy", "behaviour.loss", "behaviour.trim_pixels", "behaviour.trim_margin"),
    settings=("baselines.resnet_oracle",),
    data="demos",
    parts="playslot_rl.methods.resnet_oracle.training:training",
)
_LOAD: Final = Load(actor="playslot_rl.methods.resnet_oracle.network:load_actor")
RESNET_ORACLE: Final = Method(NAME, ("ResNet Oracle", "ResNet"), Style(1, "v"), ResNetOracleConfig, (STAGE,), _LOAD)
RESNET_BC: Final = Method("resnet_bc", ("ResNet BC",), Style(1, ">"), None, (replace(STAGE, data="labelled"),), _LOAD)
