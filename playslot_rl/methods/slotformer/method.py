"""SlotFormer on the slots of a frozen SAVi, with nothing inferred."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.slotformer.config import SlotFormerConfig

NAME: Final = "slotformer"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.savi"),
    settings=("baselines.slotformer",),
    parents=("slots",),
    parts="playslot_rl.methods.video.on_slots:training",
    sizes="playslot_rl.methods.video.on_slots:uncontrolled",
)
SLOTFORMER: Final = Method(
    NAME,
    ("SlotFormer",),
    Style(2, "^"),
    SlotFormerConfig,
    (STAGE,),
    Load(video="playslot_rl.methods.video.on_slots:slotformer"),
)
