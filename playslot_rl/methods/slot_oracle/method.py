"""The policy's network on the real actions of all demonstrations, or of the labelled ones alone (BC)."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final

from playslot_rl.config import BehaviourStageConfig
from playslot_rl.config.methods import Load, Method, Style
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
    parts="playslot_rl.methods.slot_oracle.training:training",
    names={"behaviour": NAME},
)
_LOAD: Final = Load(actor="playslot_rl.methods.slot_oracle.load:load_actor")
SLOT_ORACLE: Final = Method(NAME, ("Slot Oracle",), Style(2, "^"), None, (STAGE,), _LOAD, told="goal")
SLOT_BC: Final = replace(
    SLOT_ORACLE, name="slot_bc", titles=("Slot BC",), style=Style(2, "<"), stages=(replace(STAGE, data="labelled"),)
)
