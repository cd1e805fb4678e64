"""SVG-LP: frames predicted from latents that are inferred, or drawn from a learned prior."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.stage_spec import StageSpec

NAME: Final = "svg"
STAGE: Final = StageSpec(NAME, keys=("env.image_size", "model.policy"), settings=("baselines.svg",))
