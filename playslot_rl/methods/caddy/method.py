"""CADDY: a video model with discrete actions, a policy that clones them, and an oracle on its states."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.caddy.config import CADDYConfig, CADDYOracleConfig, CADDYPolicyConfig

MODEL: Final = StageSpec(
    "caddy",
    keys=("env.image_size", "model.policy"),
    settings=("baselines.caddy",),
    parts="playslot_rl.methods.caddy.training:model",
    title="CADDY's video model",
)
_TRIMS: Final = ("behaviour.trim_pixels", "behaviour.trim_margin")
POLICY: Final = StageSpec(
    "caddy_policy",
    keys=("model.action_decoder", "behaviour.loss", *_TRIMS, "baselines.caddy_policy.shift"),
    settings=("behaviour.labelled_demos", "behaviour.decoder_inputs", "baselines.caddy_policy"),
    parents=("caddy",),
    data="demos",
    parts="playslot_rl.methods.caddy.training:policy",
    begun_names={
        "behaviour.trim_pixels": "trim_pixels",
        "behaviour.trim_margin": "trim_margin",
        "baselines.caddy_policy.shift": "shift",
    },
)
ORACLE: Final = StageSpec(
    "caddy_oracle",
    keys=("behaviour.loss", *_TRIMS, "baselines.caddy_oracle.shift"),
    settings=("baselines.caddy_oracle",),
    parents=("caddy",),
    data="demos",
    parts="playslot_rl.methods.caddy.training:oracle",
)
_LOADED: Final = "playslot_rl.methods.caddy.load"
CADDY: Final = Method("caddy", ("CADDY",), Style(5, "s"), CADDYConfig, (MODEL,), Load(video=f"{_LOADED}:load_video"))
CADDY_POLICY: Final = Method(
    "caddy_policy",
    ("CADDY",),
    Style(6, "X"),
    CADDYPolicyConfig,
    (MODEL, POLICY),
    Load(actor=f"{_LOADED}:load_policy"),
)
CADDY_ORACLE: Final = Method(
    "caddy_oracle",
    ("CADDY Oracle",),
    Style(7, "p"),
    CADDYOracleConfig,
    (MODEL, ORACLE),
    Load(actor=f"{_LOADED}:load_oracle"),
)
