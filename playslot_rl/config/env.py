"""Config of the task: which environment, and how its frames are rendered (re-exported by `playslot_rl.config`)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Final, Literal

from playslot_rl.config import metaworld
from playslot_rl.config.families import FAMILIES, OGBENCH, OGBENCH_GOALS, member, own_camera, task_name
from playslot_rl.config.plain import check, nearest
from playslot_rl.config.roles import SEED, UNSAID, Checked, at_least, between, within

Rgb = tuple[int, int, int]
VIDEO: Final = "video"
"""`env=video`: what somebody recorded, without a simulator."""

STRENGTH: Final = between(0, 1, "0 (off) to 1")

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
class VariationConfig(Checked):
    """What changes in the picture and not in the task, drawn for each episode; all of it is off by default.

    Attributes:
        background: a drifting pattern instead of sky, floor and walls.
        textures: a pattern over the table.
        shake: how far the camera shakes, 1 by up to 4 degrees.
        light: how much its strength and colour change, over time too.
        colours: how far robot, table and ground take random colours; 1 whole.
        object: something moves before the scene, which nothing can touch.
        seed: other numbers for the same episodes.
    """

    group = "env.variation."
    background: bool = field(default=False, metadata=UNSAID)
    textures: bool = field(default=False, metadata=UNSAID)
    shake: float = field(default=0.0, metadata=UNSAID | STRENGTH)
    light: float = field(default=0.0, metadata=UNSAID | STRENGTH)
    colours: float = field(default=0.0, metadata=UNSAID | STRENGTH)
    object: bool = field(default=False, metadata=UNSAID)
    seed: int = field(default=0, metadata=UNSAID | SEED)

    @property
    def on(self) -> bool:
        """Whether anything changes."""
        return replace(self, seed=0) != VariationConfig()

    @property
    def words(self) -> list[str]:
        """What is on, as names say it: `background`, `shake0.5`, `seed1`; nothing where all is off."""
        found = {field.name: getattr(self, field.name) for field in fields(self)} if self.on else {}
        return [name if value is True else f"{name}{value:g}" for name, value in found.items() if value]


def in_turn(seed: int, tasks: int) -> int:
    """Which of several tasks the episode of a seed is of."""
    return seed % tasks


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
        variation: what changes in the picture and not in the task.
        id: of `env=gym`: a registered Gymnasium environment, `FetchReach-v4`, or `package:Id` after importing one.
        camera: of `env=gym` with MuJoCo, and `metaworld`: a name, or `distance,azimuth,elevation,x,y,z`; empty is its
            own. Meta-World's tasks with small things have `near`.
        expert: of `env=gym`, typed `expert=`: `package.module:function`, from its own observation, info and a generator
            to its action.
        success: of `env=gym`: the entry of its info that says success; empty is `is_success` or `success`.
        task: of `metaworld`: `drawer-open`, another of its fifty, or several, `MT10` or `reach+push`; of `ogbench`:
            `cube-single` or `cube-double`; of `video`: several that sets name, `Open it.+Close it.`
        goals: of `ogbench`: its five of `evaluation`, in turn, or `random` ones, as in its data.
        targets: of `ogbench`: whether they are drawn, translucent; its `visual-` environments hide them.
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
    variation: VariationConfig = field(default=VariationConfig(), metadata=UNSAID)
    id: str = field(default="", metadata=UNSAID)
    camera: str = field(default="", metadata=UNSAID)
    expert: str = field(default="", metadata=UNSAID)
    success: str = field(default="", metadata=UNSAID)
    task: str = field(default="", metadata=UNSAID)
    goals: Literal["evaluation", "random"] = field(default="evaluation", metadata=UNSAID)
    targets: bool = field(default=True, metadata=UNSAID)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Of several tasks in one, their names; empty of one."""
        if self.name == VIDEO:
            return tuple(part.strip() for part in self.task.split(metaworld.JOINT)) if self.task else ()
        return metaworld.several(self.task)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is to be done in each of `tasks`, as data sets say it."""
        return self.tasks if self.name == VIDEO else tuple(metaworld.TASKS[name].sentence for name in self.tasks)

    def number_of(self, said: str) -> int:
        """Which of `tasks` is meant, by its name or what data sets say; a ValueError where none is."""
        for known in (self.tasks, self.sentences):
            if said in known:
                return known.index(said)
        close, some = nearest(said, [*self.tasks, *self.sentences]), ", ".join(self.tasks[:10])
        raise ValueError(f"task: got {said!r}, expected one of {len(self.tasks)}: {some}{close}")

    @property
    def other_sentences(self) -> set[str]:
        """What is to be done in the tasks of its family that it is not."""
        if self.name not in FAMILIES:
            return set()
        return {task.sentence for task in FAMILIES[self.name].tasks.values()} - {member(self.name, self.task).sentence}

    def serves(self, env: EnvConfig) -> bool:
        """Whether a world model of this task is one of another, too: the same, one of several, or any of videos."""
        return self.name == env.name == VIDEO or env.typed in (
            self.typed,
            *(self._alone(task).typed for task in self.tasks if task == env.task),
        )

    def of_episode(self, seed: int) -> EnvConfig:
        """The task of several whose an episode is: each in turn by the seed; else itself."""
        return self._alone(self.tasks[in_turn(seed, len(self.tasks))]) if self.tasks else self

    def _alone(self, task: str) -> EnvConfig:
        return replace(self, task=task, camera=metaworld.seen_by(task, self.camera))

    def every(self, stride: int) -> EnvConfig:
        """The task as a policy of every `stride`-th frame acts in it: its steps are so many times longer, and fewer."""
        steps = max(2, -(-self.max_steps // stride))
        return replace(self, frame_skip=stride * self.frame_skip, max_steps=steps)

    @property
    def turns(self) -> int:
        """Tasks, or goals, that episodes take in turn by the seed; 1 where all have the same."""
        return OGBENCH_GOALS if self.name == OGBENCH and self.goals == "evaluation" else max(1, len(self.tasks))

    @property
    def full_name(self) -> str:
        """The name, the task where that has several, and what varies, as folders and reports call it."""
        own = (self.task if self.name in FAMILIES else "") or self.id.replace("/", "_").replace(":", "_")
        return "_".join((self.name, *([own] if own else []), *self.variation.words))

    @property
    def typed(self) -> list[str]:
        """The arguments that choose it; a camera where it is not the one of who types none."""
        own = [f"env.{key}={value}" for key in ("task", "id") if (value := getattr(self, key))]
        seen = [] if self.camera == own_camera(self.name, self.task) else [f"env.camera={self.camera}"]
        return [f"env={self.name}", *own, *seen]

    @property
    def seen(self) -> str:
        """How it is looked at: the camera, and what varies."""
        return ", ".join([f"env.camera={self.camera}", *self.variation.words])

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("id", "expert", "success"):
            value = getattr(self, key)
            check(self.name == "gym" or not value, f"env.{key}", value, f"none with env={self.name}: it is of env=gym")
        seen = self.name in ("gym", metaworld.NAME) or not self.camera
        check(seen, "env.camera", self.camera, f"none with env={self.name}: it is of env=gym and env={metaworld.NAME}")
        drawn = self.name not in ("grid_shapes", "sketchy", VIDEO) or not self.variation.on
        check(
            drawn,
            "env.variation",
            ", ".join(self.variation.words),
            f"nothing with env={self.name}, which no simulator draws",
        )
        if self.name in FAMILIES:
            object.__setattr__(self, "task", task_name(self.name, self.task))
            alone, small = metaworld.seen_by(self.task, self.camera), ", ".join(metaworld.SMALL)
            check(self.camera == alone, "env.camera", self.camera, f"none with env.task={self.task}: it is of {small}")
        else:
            told = self.name == VIDEO and all(self.tasks) and 1 < len(self.tasks) == len({*self.tasks})
            known = ", ".join(f"env={name}" for name in FAMILIES)
            rest = ", or several that the sets name, joined by +" if self.name == VIDEO else f": it is for {known}"
            check(told or not self.task, "env.task", self.task, f"none with env.name={self.name}{rest}")
        plain = self.goals == "evaluation" and self.targets
        cube = f"nothing with env={self.name}: they are of env={OGBENCH}"
        check(self.name == OGBENCH or plain, "env.goals, env.targets", (self.goals, self.targets), cube)
        used = self.name.startswith("block_") or self.blocks == BlocksConfig()
        check(used, "env.blocks", self.blocks, f"no changes with env.name={self.name}, which has no blocks")
