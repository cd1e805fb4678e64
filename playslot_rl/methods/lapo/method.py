"""LAPO: inverse and forward model on videos, then a latent policy and an action decoder."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.lapo.config import LAPOConfig

NAME: Final = "lapo"
SIZES: Final = ("channels", "hidden", "groups", "code_dim", "codes", "decay", "dead_threshold", "commitment")
"""Settings that inverse and forward model are built from."""
_BUILT: Final = tuple(f"baselines.lapo.{key}" for key in SIZES)
MODEL: Final = StageSpec(
    "lapo_model", keys=_BUILT, settings=("baselines.lapo.model",), stores=("model",),
    parts="playslot_rl.methods.lapo.training:model", title="LAPO's inverse and forward model",
)  # fmt: skip
POLICY: Final = StageSpec(
    NAME,
    keys=(
        "model.action_decoder", "behaviour.trim_pixels", "behaviour.trim_margin", *_BUILT, "baselines.lapo.loss",
        "baselines.lapo.targets", "baselines.lapo.shift",
    ),
    settings=(
        "behaviour.labelled_demos", "behaviour.decoder_inputs", "baselines.lapo.policy", "baselines.lapo.decoder_steps",
        "baselines.lapo.decoder_lr",
    ),
    parents=("lapo_model",),
    data="demos",
    parts="playslot_rl.methods.lapo.training:policy",
    begun_names={
        "model.action_decoder": "action_decoder",
        "behaviour.trim_pixels": "trim_pixels",
        "behaviour.trim_margin": "trim_margin",
        "baselines.lapo.loss": "loss",
        "baselines.lapo.targets": "targets",
        "baselines.lapo.shift": "shift",
    },
)  # fmt: skip
LAPO: Final = Method(
    NAME,
    ("LAPO",),
    Style(5, "s"),
    LAPOConfig,
    (MODEL, POLICY),
    Load(actor="playslot_rl.methods.lapo.load:load_actor"),
)
