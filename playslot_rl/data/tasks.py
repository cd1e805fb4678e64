"""Which of the environment's several tasks demonstrations are of, for a policy that is told.

Shapes: M transitions.
"""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from torch import Tensor

from playslot_rl.config import EnvConfig
from playslot_rl.config.env import VIDEO
from playslot_rl.config.metaworld import JOINT
from playslot_rl.data.agreement import say_once
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import recorded_tasks
from playslot_rl.errors import DataError

if TYPE_CHECKING:
    from playslot_rl.data.demonstrations import Transitions

TYPED: Final = 10
"""Tasks of which a note says what to type."""


def told_tasks(source: EpisodeFrames, moves: Transitions, env: EnvConfig) -> Tensor | None:
    """Which of the environment's `tasks` each transition is of, int64 (M, 1), by what the data set says of its episode;
    None where it has one. Raises as `require_tasks`.
    """
    require_tasks(source, env)
    if not env.tasks or source.tasks is None:
        return None
    number = {sentence: i for i, sentence in enumerate(env.sentences)}
    there = np.flatnonzero(source.lengths >= 2)
    there = there[np.unique(source.numbers[there], return_index=True)[1]]
    return torch.tensor([number[said] for said in source.tasks[there].tolist()])[moves.episode][:, None]


def require_tasks(source: EpisodeFrames, env: EnvConfig) -> None:
    """Refuse demonstrations of none of the environment's `tasks`, or of another task of its family, by a DataError; say
    where they are of several that are not told apart.
    """
    said = {"nothing"} if source.tasks is None else {*source.tasks.tolist()}
    unknown = sorted(said - {*env.sentences} if env.tasks else said & env.other_sentences)
    lost = sorted({*env.sentences} - said) if env.name == VIDEO else []
    if unknown:
        raise DataError(
            f"{source.name}: got demonstrations of {unknown[0]!r}, expected the tasks of env.task={env.task} alone: "
            + ("name it, too, or leave its episodes out" if env.name == VIDEO else "collect them with it")
            + (f"; none are of {lost[0]!r}" if lost else "")
        )
    tasks = sorted(said - {""})
    if not env.tasks and len(tasks) > 1:
        say_once(
            f"note: {source.name}: got demonstrations of {len(tasks)} tasks ({tasks[0]!r}, {tasks[1]!r}, ...), which "
            "one policy is not told apart: "
            + (
                f"tell it which by {_typed(tasks)} from train-slots on, or "
                if env.name == VIDEO and _can_be_typed(said)
                else ""
            )
            + "train on those of one, a set that `playslot dataset split` makes without --fractions"
        )


def say_missing(source: EpisodeFrames, env: EnvConfig, videos: bool) -> None:
    """Say which of the tasks of `env.task` none of a robot's episodes is of; of `videos`, which need not be of all,
    where some are of another task: one of them may be misspelt."""
    recorded = set() if source.tasks is None else {*source.tasks.tolist()} - {""}
    missing, others = {*env.sentences} - recorded, recorded - {*env.sentences}
    if env.name == VIDEO and env.tasks and missing and (others or not videos):
        lost, there = (", ".join(map(repr, sorted(tasks)[:3])) for tasks in (missing, others))
        but = f", but some of {there}" if others else ""
        say_once(f"note: {source.name}: got no episode of {lost}{but}: is env.task={env.task} as meant?")


def _can_be_typed(said: set[str]) -> bool:
    return all(task.strip() and JOINT not in task for task in said)


def _typed(tasks: list[str]) -> str:
    return shlex.quote(f"env.task={JOINT.join(tasks)}") if len(tasks) <= TYPED else f"env.task=, all joined by {JOINT}"


def say_untaught(source: EpisodeFrames, env: EnvConfig, labelled: int | None) -> None:
    """Say of which of the environment's `tasks` none of the first `labelled` demonstrations (None: all) is, whose
    actions nothing teaches."""
    shown = {*recorded_tasks(source)[:labelled]}
    missing = [sentence for sentence in env.sentences if sentence not in shown]
    if shown and missing:
        number = "" if labelled is None else f" of the first {labelled}"
        some = repr(missing[0]) + (f" and {len(missing) - 1} others" if missing[1:] else "")
        say_once(
            f"note: {source.name}: got no labelled demonstration{number} of {some} of env.task={env.task}, whose "
            "actions other tasks' labels alone teach: label more (behaviour.labelled_demos, or demos) or record some"
        )
