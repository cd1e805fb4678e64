"""A video comparison that was begun with other settings is refused in words of the settings that were typed.

A trial and a training know their steps, learning rates and clips, and would name those; which key of the comparison
they come from is known here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from playslot_rl.config import to_dict
from playslot_rl.config.compare_video import CompareVideoConfig
from playslot_rl.errors import CheckpointError
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.studies.video.jobs import VideoJob, makes_trials

TRAINED_WITH: Final = ("trained_seed", "trained_frames", "tested")
"""Settings that a trial and a training are made with."""
TRIED_WITH: Final = (*TRAINED_WITH, "trial_steps")
"""And those of a trial alone."""


def require_begun_alike(jobs: Iterable[VideoJob], asked: CompareVideoConfig) -> None:
    """Refuse settings other than those with which a job's training or trials were begun, before anything is computed.

    Raises:
        CheckpointError: names the key that was typed.
    """
    wanted = to_dict(asked)
    for job in jobs:
        tried = [job.trial(rate) for rate in asked.rates] if makes_trials(asked) else []
        for folder, names in [*((trial, TRIED_WITH) for trial in tried), (job.run, TRAINED_WITH)]:
            stored = _begun_with(folder)
            for name, got, old in _differences(stored, wanted, names):
                raise _other(name, got, old, folder)


def require_same_choice(
    job: VideoJob, asked: CompareVideoConfig, choice: Mapping[str, Any], before: Mapping[str, Any]
) -> None:
    """Refuse a learning rate or a number of steps that a job's training was not begun with.

    Args:
        job: whose.
        asked: the comparison's settings.
        choice, before: `rate` and `steps` that the trials lead to now, and led to then (empty for nothing).

    Raises:
        CheckpointError: names the key that was typed.
    """
    stored = _begun_with(job.run)
    if not before or not stored:
        return
    wanted = to_dict(asked)
    for key, name, unit in (("rate", "rates", "a rate of {:g}"), ("steps", "budget_minutes", "{} steps")):
        if choice[key] != before[key] and stored[name] != wanted[name]:
            got = f"{wanted[name]}, which leads to {unit.format(choice[key])}"
            raise _other(name, got, f"{stored[name]} and {unit.format(before[key])}", job.run)


def _begun_with(folder: Path) -> dict[str, Any]:
    """The comparison's settings in a run's config; empty where there is no run."""
    stored = json_or_nothing(folder / "config.json").get("compare_video")
    return stored if isinstance(stored, dict) else {}


def _differences(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], names: Iterable[str]
) -> Iterator[tuple[str, Any, Any]]:
    """Key, wanted and stored value of settings that differ."""
    for name in names:
        test, old = wanted["test"], stored.get("test", wanted["test"])
        if name == "tested" and (old or test):
            if bool(old) != bool(test):  # then no episodes are kept back for it
                yield "test", test or "nothing", old or "nothing"
        elif stored.get(name, wanted[name]) != wanted[name]:
            yield name, wanted[name], stored[name]


def _other(name: str, got: Any, old: Any, folder: Path) -> CheckpointError:
    key = f"{CompareVideoConfig.group}{name}"
    return CheckpointError(
        f"{key}: got {got}, expected {old}, with which {folder} was begun: set {key} back, use another out=, or delete "
        "that folder"
    )
