"""PlaySlot: SAVi, the dynamics in its slots, and the policy in their latent actions."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec

SLOTS: Final = StageSpec(
    "slots",
    keys=("env.image_size", "model.savi"),
    settings=("slots",),
    parts="playslot_rl.methods.playslot.slots:training",
)
DYNAMICS: Final = StageSpec(
    "dynamics",
    keys=("model.inverse_dynamics", "model.predictor"),
    settings=("dynamics",),
    parents=("slots",),
    copies=True,
    parts="playslot_rl.methods.playslot.dynamics:training",
)
POLICY: Final = StageSpec(
    "policy",
    keys=("model.policy", "model.action_decoder"),
    settings=("behaviour",),
    begun=("model",),
    parents=("slots", "dynamics"),
    data="demos",
    parts="playslot_rl.methods.playslot.policy:training",
    sizes="playslot_rl.methods.playslot.policy:sizes",
    names={"behaviour": "policy"},
)
PLAYSLOT: Final = Method(
    "playslot",
    ("PlaySlot",),
    Style(0, "o"),
    None,
    (SLOTS, DYNAMICS, POLICY),
    Load(actor="playslot_rl.methods.playslot.load:load_actor", video="playslot_rl.methods.playslot.load:load_video"),
    told="goal",
)
