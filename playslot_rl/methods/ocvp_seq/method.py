"""OCVP-Seq on the slots of a frozen SAVi, with nothing inferred."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.ocvp_seq.config import OCVPSeqConfig

NAME: Final = "ocvp_seq"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.savi"),
    settings=("baselines.ocvp_seq",),
    parents=("slots",),
    parts="playslot_rl.methods.video.on_slots:training",
    sizes="playslot_rl.methods.video.on_slots:uncontrolled",
)
OCVP_SEQ: Final = Method(
    NAME,
    ("OCVP-Seq", "OCVP"),
    Style(3, "D"),
    OCVPSeqConfig,
    (STAGE,),
    Load(video="playslot_rl.methods.video.on_slots:ocvp_seq"),
)
