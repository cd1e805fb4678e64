"""Config of the task: which environment, and how its frames are rendered (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config.plain import check
from playslot_rl.config.roles import Checked, at_least, between, within

Rgb = tuple[int, int, int]

COLOURS: Final[dict[str, Rgb]] = {
    "lime": (0, 255, 0),
    "darkslategrey": (47, 79, 79),
    "saddlebrown": (139, 69, 19),
    "midnightblue": (25, 25, 112),
    "darkgreen": (0, 100, 0),
    "darkkhaki": (189, 183, 107),
    "mediumturquoise": (72, 209, 204),
    "red": (255, 0, 0),
    "orange": (255, 165, 0),
    "yellow": (255, 255, 0),
    "mediumvioletred": (199, 21, 133),
    "mediumblue": (0, 0, 205),
    "mediumspringgreen": (0, 250, 154),
    "thistle": (216, 191, 216),
    "magenta": (255, 0, 255),
    "dodgerblue": (30, 144, 255),
}
"""Colours of the blocks: CSS name -> sRGB [0, 255]."""


@dataclass(frozen=True)
class RenderConfig(Checked):
    """How frames are rendered, for data and for evaluation alike.

    Attributes:
        quality: `fast` (no shadows, no multisampling, box-averaged supersampling) or `full` (MuJoCo's default look).
        supersample: side factor of the `fast` path; 2 renders at twice the size and averages 2x2 boxes.
    """

    group = "render."
    quality: Literal["fast", "full"] = "fast"
    supersample: int = field(default=2, metadata=between(1, 8, "an integer from 1 to 8"))


@dataclass(frozen=True)
class GridConfig(Checked):
    """GridShapes, read by `env=grid_shapes` only.

    Attributes:
        objects: shapes in a clip, 1 to 5; `action_dim` is twice that.
        size: side of a shape, pixels.
        speed: pixels a step.
        change: probability that a shape draws a new direction at a step.
    """

    group = "env.grid."
    objects: int = field(default=2, metadata=between(1, 5, "1 to 5"))
    size: int = field(default=15, metadata=between(3, 128, "at least 3 pixels, 128 at most"))
    speed: int = field(default=2, metadata=between(1, 128, "at least 1 pixel, 128 at most"))
    change: float = field(default=0.25, metadata=between(0, 1, "a probability"))


@dataclass(frozen=True)
class BlocksConfig(Checked):
    """The blocks family, read by `env=block_push`, `block_push_easy`, `block_reach` and `block_pick` only.

    Attributes:
        task: which object: `red`, `reddest` (nearest to red by CIEDE2000), `odd` (all others share another colour) or
            `odd_groups` (the others form groups of a colour).
        distractors: other objects, 0 to 4.
        distractors_to: where given, each episode draws their number from `distractors` to this.
        colour: colour of the odd object (a name in `COLOURS`); empty draws it for each episode.
        reward: `dense` or `sparse`.
    """

    group = "env.blocks."
    task: Literal["red", "reddest", "odd", "odd_groups"] = "odd"
    distractors: int = field(default=3, metadata=between(0, 4, "0 to 4"))
    distractors_to: int | None = field(default=None, metadata=between(0, 4, "0 to 4, or null"))
    colour: str = ""
    reward: Literal["dense", "sparse"] = "dense"

    def __post_init__(self) -> None:
        super().__post_init__()
        last = self.distractors if self.distractors_to is None else self.distractors_to
        limits = f"{self.distractors} (env.blocks.distractors) to 4, or null"
        check(self.distractors <= last <= 4, "env.blocks.distractors_to", last, limits)
        if self.colour:
            check(self.colour in COLOURS, "env.blocks.colour", self.colour, f"one of {', '.join(COLOURS)}")
            odd = self.task in ("odd", "odd_groups")
            check(odd, "env.blocks.colour", self.colour, f"no colour with env.blocks.task={self.task}")


@dataclass(frozen=True)
class EnvConfig(Checked):
    """The task.

    Attributes:
        name: environment name (`button_press`, `block_push`, `grid_shapes`, ...).
        image_size: side of the square frames, pixels.
        action_dim: width A of the real action.
        frame_skip: environment steps per agent step, all with the same action.
        max_steps: agent steps in an episode.
        warmup_steps: random agent steps after each reset, before the first observation.
        grid: settings of `grid_shapes`.
        blocks: settings of the `block_*` environments.
    """

    group = "env."
    name: str = "button_press"
    image_size: int = field(default=64, metadata=within((32, 64, 128).__contains__, "32, 64 or 128", 32, 128))
    action_dim: int = field(default=4, metadata=between(1, 4096, "1 to 4096"))
    frame_skip: int = field(default=5, metadata=at_least(1, largest=100))
    max_steps: int = field(default=20, metadata=at_least(2, largest=10**6))
    warmup_steps: int = field(default=12, metadata=at_least(0, "0 or more", 10_000))
    grid: GridConfig = field(default_factory=GridConfig)
    blocks: BlocksConfig = field(default_factory=BlocksConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        used = self.name.startswith("block_") or self.blocks == BlocksConfig()
        check(used, "env.blocks", self.blocks, f"no changes with env.name={self.name}, which has no blocks")
