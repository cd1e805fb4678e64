"""The slot oracle: the policy's network on the real actions of all demonstrations."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from playslot_rl.config import BehaviourStageConfig
from playslot_rl.config.roles import keys_of
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.config.stages import AFTER_CLONING

NAME: Final = "slot_oracle"
_NOT_ITS: Final = {*AFTER_CLONING, *keys_of(BehaviourStageConfig, "free")}
STAGE: Final = StageSpec(
    NAME,
    keys=("model.policy",),
    settings=tuple(f"behaviour.{f.name}" for f in fields(BehaviourStageConfig) if f.name not in _NOT_ITS),
    parents=("slots",),
    data="demos",
    names={"behaviour": NAME},
)
