"""SVG-LP: frames predicted from latents that are inferred, or drawn from a learned prior."""

from __future__ import annotations

from typing import Final

from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.svg.config import SVGConfig

NAME: Final = "svg"
STAGE: Final = StageSpec(
    NAME,
    keys=("env.image_size", "model.policy"),
    settings=("baselines.svg",),
    parts="playslot_rl.methods.svg.training:training",
)
SVG: Final = Method(
    NAME,
    ("SVG-LP", "SVG"),
    Style(1, "v"),
    SVGConfig,
    (STAGE,),
    Load(video="playslot_rl.methods.svg.training:load_video"),
)
