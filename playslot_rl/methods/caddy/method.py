"""CADDY: a video model with discrete actions, a policy that clones them, and an oracle on its states."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

MODEL: Final = StageSpec("caddy", keys=("env.image_size", "model.policy"), settings=("baselines.caddy",))
_TRIMS: Final = ("behaviour.trim_pixels", "behaviour.trim_margin")
POLICY: Final = StageSpec(
    "caddy_policy",
    keys=("model.action_decoder", "behaviour.loss", *_TRIMS, "baselines.caddy_policy.shift"),
    settings=("behaviour.labelled_demos", "behaviour.decoder_inputs", "baselines.caddy_policy"),
    parents=("caddy",),
    data="demos",
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
)
