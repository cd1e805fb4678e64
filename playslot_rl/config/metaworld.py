"""Meta-World's fifty tasks: what each asks for, and for how many agent steps an episode of it lasts."""

from __future__ import annotations

from typing import Final, NamedTuple

NAME: Final = "metaworld"
VERSION: Final = "-v3"
BUTTON_PRESS: Final = "button_press"
"""The one task with an environment name of its own."""
DEFAULT: Final = "drawer-open"


class Member(NamedTuple):
    """A task.

    Attributes:
        steps: agent steps of five environment steps, enough for its expert.
        sentence: what is to be done.
    """

    steps: int
    sentence: str


TASKS: Final[dict[str, Member]] = {
    "assembly": Member(20, "Pick up the nut and put it on the peg."),
    "basketball": Member(30, "Put the ball into the basket."),
    "bin-picking": Member(35, "Carry the cube from one bin to the other."),
    "box-close": Member(30, "Put the lid on the box."),
    "button-press": Member(20, "Press the red button."),
    "button-press-topdown": Member(20, "Press the red button from above."),
    "button-press-topdown-wall": Member(20, "Press the red button behind the wall from above."),
    "button-press-wall": Member(20, "Reach over the wall and press the red button."),
    "coffee-button": Member(20, "Press the button of the coffee machine."),
    "coffee-pull": Member(20, "Pull the mug away from the coffee machine to the goal."),
    "coffee-push": Member(20, "Push the mug under the coffee machine."),
    "dial-turn": Member(25, "Turn the dial."),
    "disassemble": Member(40, "Take the nut off the peg."),
    "door-close": Member(20, "Close the door."),
    "door-lock": Member(30, "Turn the lock of the door down."),
    "door-open": Member(25, "Open the door."),
    "door-unlock": Member(20, "Turn the lock of the door aside."),
    "drawer-close": Member(20, "Push the drawer shut."),
    "drawer-open": Member(20, "Pull the drawer open."),
    "faucet-close": Member(20, "Turn the faucet clockwise."),
    "faucet-open": Member(20, "Turn the faucet counter-clockwise."),
    "hammer": Member(30, "Hit the nail with the hammer."),
    "hand-insert": Member(20, "Put the cube into the hole with the hand."),
    "handle-press": Member(20, "Press the handle down."),
    "handle-press-side": Member(20, "Press the handle down from the side."),
    "handle-pull": Member(40, "Pull the handle up."),
    "handle-pull-side": Member(40, "Pull the handle up from the side."),
    "lever-pull": Member(20, "Pull the lever up."),
    "peg-insert-side": Member(40, "Put the peg into the hole in the side of the box."),
    "peg-unplug-side": Member(35, "Pull the peg out of the box."),
    "pick-out-of-hole": Member(30, "Lift the cube out of the hole to the goal."),
    "pick-place": Member(20, "Lift the puck to the goal."),
    "pick-place-wall": Member(25, "Lift the puck over the wall to the goal."),
    "plate-slide": Member(20, "Slide the plate into the net."),
    "plate-slide-back": Member(20, "Slide the plate out of the net."),
    "plate-slide-back-side": Member(20, "Slide the plate sideways out of the net."),
    "plate-slide-side": Member(20, "Slide the plate sideways into the net."),
    "push": Member(20, "Push the puck to the goal."),
    "push-back": Member(20, "Pull the block back to the goal."),
    "push-wall": Member(20, "Push the puck round the wall to the goal."),
    "reach": Member(20, "Move the hand to the goal."),
    "reach-wall": Member(20, "Move the hand over the wall to the goal."),
    "shelf-place": Member(25, "Put the cube on the shelf."),
    "soccer": Member(30, "Push the ball into the goal."),
    "stick-pull": Member(35, "Pull the thermos to the goal with the stick."),
    "stick-push": Member(20, "Push the thermos to the goal with the stick."),
    "sweep": Member(25, "Sweep the cube off the table."),
    "sweep-into": Member(20, "Sweep the cube into the hole."),
    "window-close": Member(20, "Slide the window shut."),
    "window-open": Member(20, "Slide the window open."),
}

SETS: Final[dict[str, tuple[str, ...]]] = {
    "MT10": (
        "reach", "push", "pick-place", "door-open", "drawer-open", "drawer-close", "button-press-topdown",
        "peg-insert-side", "window-open", "window-close",
    )
}  # fmt: skip
"""Several tasks under one name, in Meta-World's order: which of them an episode is follows from its seed."""

NEAR: Final = "near"
"""The camera of `SMALL` tasks, and of sets with some."""
SMALL: Final = (
    "reach", "reach-wall", "push", "push-back", "push-wall", "pick-place", "pick-place-wall", "sweep-into", "soccer",
)  # fmt: skip
"""Tasks on the open table, whose things have less than ten pixels, or whose goals, from where the others are seen."""

JOINT: Final = "+"
"""Between the names of tasks that make a set."""


def several(task: str) -> tuple[str, ...]:
    """The tasks of a set, by its name or theirs (`reach+push`); empty of one task."""
    return SETS.get(task, tuple(task.split(JOINT)) if JOINT in task else ())


def has_small(task: str) -> bool:
    """Whether it is of `SMALL`, or a set with some."""
    return any(name.removesuffix(VERSION) in SMALL for name in several(task) or (task,))


def seen_by(task: str, camera: str) -> str:
    """The camera of a task whose set has `camera`."""
    return "" if camera == NEAR and not has_small(task) else camera


def member(task: str) -> Member:
    """A task, or a set of them, which lasts as long as its longest."""
    tasks = several(task)
    if not tasks:
        return TASKS[task]
    return Member(max(TASKS[name].steps for name in tasks), f"One of {task}: {', '.join(tasks)}.")


EVERY: Final[dict[str, Member]] = {name: member(name) for name in (*TASKS, *SETS)}
"""Tasks, and sets of them that have a name."""
