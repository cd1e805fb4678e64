"""PlaySlot's three stages."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

SLOTS: Final = StageSpec("slots", keys=("env.image_size", "model.savi"), settings=("slots",))
DYNAMICS: Final = StageSpec(
    "dynamics",
    keys=("model.inverse_dynamics", "model.predictor"),
    settings=("dynamics",),
    parents=("slots",),
)
POLICY: Final = StageSpec(
    "policy",
    keys=("model.policy", "model.action_decoder"),
    settings=("behaviour",),
    begun=("model",),
    parents=("slots", "dynamics"),
    data="demos",
    names={"behaviour": "policy"},
)
