"""Where the objects of an episode are, which colours they have, and which of them the task is about.

Shapes: n objects (the task's and its distractors). Lengths in metres, world coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from playslot_rl.config import BlocksConfig
from playslot_rl.config.env import COLOURS, Rgb

Variant = Literal["reach", "push", "pick"]

TABLE_TOP: Final = 0.4
CUBE: Final = 0.045  # half the side of the cubes of Reach and Push
SMALL_CUBE: Final = 0.03
"""Half the side of Pick's cubes. Note: the gripper opens 0.10 m, which leaves no play round a cube of 0.09 m."""
SPREAD: Final = 0.15  # objects and goal lie at most this far from the grip's start, in x and in y
APART: Final = 0.127  # least distance between two objects
GOAL_APART: Final = 0.104
"""Least distance in the plane from the goal to every object (Reach: in space from the target to the grip), so that no
episode starts solved."""
LIFT: Final = (0.10, 0.20)  # how far Pick's goal is above a cube on the table
TRIES: Final = 256
"""Layouts drawn at once; the first that fits is taken. One in some hundred does with four distractors."""
REACH_Z: Final = (TABLE_TOP + 0.045, TABLE_TOP + 0.245)  # heights of Reach's spheres

REDNESS: Final = (
    "red", "saddlebrown", "mediumvioletred", "orange", "thistle", "magenta", "darkkhaki", "darkslategrey", "dodgerblue",
    "midnightblue", "mediumblue", "mediumturquoise", "yellow", "darkgreen", "mediumspringgreen", "lime",
)  # fmt: skip
"""The colours by their CIEDE2000 difference from pure red; a test computes it."""

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """The start of an episode: centres (n, 3), colours uint8 (n, 3), the task's object, where that belongs (3,)."""

    places: Vector
    colours: npt.NDArray[np.uint8]
    target: int
    goal: Vector


def draw_layout(rng: np.random.Generator, variant: Variant, config: BlocksConfig, start: Vector) -> Layout:
    """Draw an episode."""
    last = config.distractors if config.distractors_to is None else config.distractors_to
    count = 1 + int(rng.integers(config.distractors, last + 1))
    colours, target = draw_colours(rng, config, count)
    rgb = np.array(colours, np.uint8)
    if variant == "reach":
        places = _reach_places(rng, start, count, target)
        return Layout(places, rgb, target, places[target].copy())
    places = _scatter(rng, start, count, with_goal=True)
    places[:, 2] = TABLE_TOP + (SMALL_CUBE if variant == "pick" else CUBE)
    goal = places[count].copy()
    if variant == "pick":
        goal[2] += rng.uniform(*LIFT)
    return Layout(places[:count], rgb, target, goal)


def _scatter(rng: np.random.Generator, start: Vector, count: int, with_goal: bool) -> Vector:
    """Places of `count` objects and, last, of the goal, `SPREAD` round the start: (count [+ 1], 3) with z = 0.

    All are drawn anew when two are too close, which leaves every layout that fits equally likely.
    """
    total = count + with_goal
    least = np.full((total, total), APART)
    if with_goal:
        least[:, -1] = GOAL_APART
    first, second = np.triu_indices(total, 1)
    while True:
        xy = start[:2] + rng.uniform(-SPREAD, SPREAD, (TRIES, total, 2))
        gaps = np.linalg.norm(xy[:, first] - xy[:, second], axis=-1)
        fits = (gaps >= least[first, second]).all(axis=1)
        if fits.any():
            return np.concatenate([xy[fits.argmax()], np.zeros((total, 1))], axis=1)


def _reach_places(rng: np.random.Generator, start: Vector, count: int, target: int) -> Vector:
    while True:
        places = _scatter(rng, start, count, with_goal=False)
        places[:, 2] = rng.uniform(*REACH_Z, count)
        if np.linalg.norm(places[target] - start) >= GOAL_APART:
            return places


def draw_colours(rng: np.random.Generator, config: BlocksConfig, count: int) -> tuple[list[Rgb], int]:
    """Colours of `count` objects and the index of the one the task is about.

    `red`: it is red, no other is. `reddest`: all colours differ, it is the nearest to red by CIEDE2000. `odd`: all
    others share one colour. `odd_groups`: it alone has its colour, the others form groups of two or three.
    `config.colour` fixes the colour of the odd one. With one distractor nobody can see which of two is the odd one.
    """
    names = list(COLOURS)
    if config.task == "reddest":
        drawn = [names[i] for i in rng.choice(len(names), count, replace=False)]
        return [COLOURS[name] for name in drawn], int(np.argmin([REDNESS.index(name) for name in drawn]))
    own = "red" if config.task == "red" else config.colour or names[int(rng.integers(len(names)))]
    rest = [name for name in names if name != own]
    order = [rest[i] for i in rng.permutation(len(rest))]
    groups = {"red": count, "odd": 1, "odd_groups": max(1, (count - 1) // 2)}[config.task]
    others = [order[i % groups] for i in range(count - 1)]
    return [COLOURS[name] for name in [own, *others]], 0
