"""Environments with several tasks, of which `env.task` chooses one."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final, NamedTuple

from playslot_rl.config import metaworld
from playslot_rl.config.metaworld import Member
from playslot_rl.config.plain import check, nearest

OGBENCH: Final = "ogbench"
OGBENCH_GOALS: Final = 5
"""Goals of its evaluation, which episodes take in turn."""
GYM: Final = "gym"


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
    if env == metaworld.NAME and metaworld.JOINT in task:
        parts = [name.removesuffix(family.version) for name in task.split(metaworld.JOINT)]
        for name in parts:
            near = nearest(name, metaworld.TASKS, most=3)
            check(name in metaworld.TASKS, "env.task", name, f"Meta-World's tasks, joined{near}")
        check(len({*parts}) == len(parts), "env.task", task, "each task once")
        return metaworld.JOINT.join(parts)
    found, count = task.removesuffix(family.version), len(family.tasks)
    known = f"{family.title}'s {count} (docs/reference/environments.md)" if count > 5 else ", ".join(family.tasks)
    check(found in family.tasks, "env.task", task, f"one of {known}{nearest(found, family.tasks, most=3)}")
    return found


def member(env: str, task: str) -> Member:
    """A task of an environment that has several, or a set of them, by what `task_name` reads."""
    name = task_name(env, task)
    return FAMILIES[env].tasks[name] if env == OGBENCH else metaworld.member(name)


def own_camera(env: str, task: str) -> str:
    """`env.camera` of who types none."""
    return metaworld.NEAR if env == metaworld.NAME and metaworld.has_small(task_name(env, task)) else ""


def preset_values(env: Mapping[str, Any], preset: str, rollout: int, brought: Collection[str]) -> dict[str, Any]:
    """What a task changes in a preset whose dynamics predict `rollout` frames: its camera, the length of its episodes,
    and of all that is as long as they are. No preset knows `env=gym` and tasks that are `brought`: `env` says how long
    theirs are.
    """
    if env["name"] in FAMILIES:
        try:
            steps = member(env["name"], str(env["task"])).steps
        except ValueError:
            return {}  # said where the task is read
        rollout = rollout if preset == "paper" else steps - 2
    elif env["name"] in (GYM, *brought) and isinstance(env["max_steps"], int):
        steps = env["max_steps"]
        rollout = max(1, min(rollout, steps - 2))
    else:
        return {}
    camera = own_camera(env["name"], str(env.get("task", "")))
    own = {"camera": camera} if camera else {}
    if preset == "smoke":
        return {"env": own}
    return {
        "env": {"max_steps": steps, **own},
        "collect": {"random_steps": steps, "expert_steps": steps},
        "model": {"predictor": {"context": steps + 4}},  # past it imagination evicts frames and falls apart
        "dynamics": {"predicted_frames": rollout},
    }
