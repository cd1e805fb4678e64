"""Environments with several tasks, of which `env.task` chooses one."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from playslot_rl.config import metaworld
from playslot_rl.config.metaworld import Member
from playslot_rl.config.plain import check, nearest

OGBENCH: Final = "ogbench"


class Family(NamedTuple):
    """The tasks of one environment.

    Attributes:
        title: what it is called.
        version: what its authors' names of tasks end in, which may be typed too.
        default: the task of who names none.
        tasks: by their names.
    """

    title: str
    version: str
    default: str
    tasks: dict[str, Member]


FAMILIES: Final = {
    metaworld.NAME: Family("Meta-World", metaworld.VERSION, metaworld.DEFAULT, metaworld.EVERY),
    OGBENCH: Family(
        "OGBench",
        "-v0",
        "cube-single",
        {
            "cube-single": Member(25, "Put the cube at its target."),
            "cube-double": Member(45, "Put both cubes at their targets."),
        },
    ),
}


def task_name(env: str, task: str) -> str:
    """The task of an environment's name and `env.task`, either of which may end in its version; a ValueError where
    there is none of that name, with the three nearest.
    """
    if env == metaworld.BUTTON_PRESS:
        return "button-press"
    family = FAMILIES[env]
    found, count = task.removesuffix(family.version), len(family.tasks)
    known = f"{family.title}'s {count} (docs/reference/environments.md)" if count > 5 else ", ".join(family.tasks)
    check(found in family.tasks, "env.task", task, f"one of {known}{nearest(found, family.tasks, most=3)}")
    return found


def preset_values(env: str, task: str, preset: str) -> dict[str, Any]:
    """What a task changes in a preset: the length of its episodes, and of all that is as long as they are."""
    family = FAMILIES.get(env)
    task = task.removesuffix(family.version) if family else ""
    if family is None or preset == "smoke" or task not in family.tasks:
        return {}
    steps = family.tasks[task].steps
    values = {
        "env": {"max_steps": steps},
        "collect": {"random_steps": steps, "expert_steps": steps},
        "model": {"predictor": {"context": steps + 4}},  # past it imagination evicts frames and falls apart
    }
    rollout = {"dynamics": {"predicted_frames": steps - 2}}
    return values if preset == "paper" else values | rollout
