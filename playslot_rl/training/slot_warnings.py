"""What a validation of SAVi says is wrong with its slots, in words that name the cure that is known for it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from playslot_rl.config import SAViConfig, SlotsStageConfig

SINGLE: Final = 1.5
"""Slots in use, below which one holds everything."""
SHARED: Final = 0.95
"""Entropy of the masks, as a share of log N, above which no slot has a pixel for itself."""
FLICKER: Final = 0.1
"""Exchanges of slots a transition, above which slots do not keep their things."""
SPLIT: Final = 1.5
"""Slots an object, above which objects are spread over several; only a simulator's segmentation tells."""
UNSEEN: Final = 0.3
"""Share of the moving pixels' change that is explained, below which what moves is not drawn."""


MAGNIFIED: Final = 1500
"""First steps with magnified frames that took slots off the plateau, of a stage that is three times as long or more."""
FOREGROUND: Final = 30
"""Weight with which goals and cubes of 4 to 40 pixels were drawn."""


def slot_warnings(values: Mapping[str, float], savi: SAViConfig, stage: SlotsStageConfig) -> dict[str, str]:
    """Kind -> one line, for each thing that is wrong with the values of `SlotHealth` and of
    `playslot_rl.evaluation.objects`; what is not among them is not judged. No cure is named that is in use already, or
    takes longer than the stage.
    """
    found: dict[str, str] = {}
    slots, entropy = savi.n_slots, values.get("mask_entropy", 0.0)
    if slots == 1:
        return found
    shared = entropy > SHARED * math.log(slots)
    if shared:
        found["shared"] = (
            f"all slots share all pixels (mask entropy {entropy:.2f} of at most {math.log(slots):.2f}): the scene is "
            f"not taken apart yet; {_leave_plateau(savi, stage)}"
        )
    elif values.get("slots_in_use", slots) < SINGLE:
        found["single"] = (
            f"one slot holds everything ({values['slots_in_use']:.1f} of {slots} slots in use): it can draw whole "
            f"frames alone; {', or '.join([*_less_room(savi, stage), _leave_plateau(savi, stage)])}"
        )
    elif values.get("slots_per_object", 1.0) > SPLIT:
        found["split"] = (
            f"objects are spread over several slots ({values['slots_per_object']:.1f} each, FG-ARI "
            f"{values.get('foreground_ari', math.nan):.2f}): "
            f"{', or '.join(_less_room(savi, stage) or [_LONGER.format(stage.steps)])}"
        )
    if values.get("flicker", 0.0) > FLICKER and not shared:
        cure = _LONGER.format(stage.steps) if savi.transition_start == "identity" else _IDENTITY
        found["flicker"] = f"slots change places ({values['flicker']:.2f} exchanges a transition): {cure}"
    if values.get("moving_explained", 1.0) < UNSEEN:
        weighed = stage.motion_weight or stage.foreground_weight
        weight = "" if weighed else f"weigh what is not background (slots.foreground_weight={FOREGROUND}), "
        found["unseen"] = (
            f"what moves is hardly drawn ({100 * values['moving_explained']:.0f} % of the moving pixels' change "
            f"explained): {weight}{_leave_plateau(savi, stage)}"
        )
    return found


_IDENTITY: Final = "start the transition as identity, model.savi.transition_start=identity"
_LONGER: Final = "train for longer than {} steps (slots.steps=, or minutes= of adopt)"
_LEARNED: Final = "let the decoder learn its position map (model.savi.decoder_position=learned)"


def _less_room(savi: SAViConfig, stage: SlotsStageConfig) -> list[str]:
    """Other sizes than those of the SAVi that is started from cannot be had."""
    sizes = f"model.savi.slot_dim (now {savi.slot_dim}) and fewer"
    channels = f"model.savi.decoder_channels (now {list(savi.decoder_channels)})"
    return [] if stage.start_from else [f"give slots less room by a smaller {sizes} {channels}"]


def _leave_plateau(savi: SAViConfig, stage: SlotsStageConfig) -> str:
    """What is left to do of what has helped; the last of them always is."""
    cures = []
    if savi.decoder_position != "learned" and savi.decoder == "pixel_shuffle" and not stage.start_from:
        cures.append(_LEARNED)
    if stage.steps >= 3 * MAGNIFIED and stage.zoom_steps < MAGNIFIED:
        cures.append(f"show magnified frames first (slots.zoom_steps={MAGNIFIED}, now {stage.zoom_steps})")
    if not stage.start_from:
        cures.append("start from one that can do it (slots.start_from=pretrained/ENV)")
    return ", or ".join([*cures, _LONGER.format(stage.steps)])
