"""Video PreTraining on slots: an inverse dynamics model of few labels, and the policy's network on what it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from playslot_rl.config.methods import Load, Style
from playslot_rl.methods.slot_oracle.method import SLOT_ORACLE, STAGE

NAME: Final = "slot_vpt"
_LABELLER: Final = tuple(f"behaviour.{key}" for key in ("labelled_demos", "decoder_steps", "decoder_lr"))
SLOT_VPT: Final = replace(
    SLOT_ORACLE,
    name=NAME,
    titles=("VPT on slots", "VPT"),
    style=Style(2, "$V$"),
    stages=(
        replace(
            STAGE, name=NAME, settings=(*STAGE.settings, *_LABELLER),
            parts="playslot_rl.methods.slot_vpt.training:training", names={"behaviour": NAME},
        ),
    ),
    load=Load(actor="playslot_rl.methods.slot_vpt.load:load_actor"),
)  # fmt: skip
