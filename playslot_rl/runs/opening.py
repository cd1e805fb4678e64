"""The runs that a command names: the one it reads, the one it writes, and whether they and its task fit together."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from playslot_rl.config import EnvConfig, ExperimentConfig
from playslot_rl.config.compose import is_pretrained
from playslot_rl.errors import ConfigError, OutputError
from playslot_rl.runs.run import Run

if TYPE_CHECKING:
    from playslot_rl.storage.checkpoints import StageCheckpoint

STAGE_LOCK: Final = "training.lock"
"""Of the command that trains a stage, in the stage's folder."""
SAME_TASK: Final = ("name", "task", "id", "image_size", "action_dim")
"""Of an environment: what it shares with the one that a policy was trained for."""
_KNOWN: Final = ("slots", "dynamics", "policy", "world_model.json", "adopt.json")
"""What a run folder without `config.json` may hold."""


def run_to_read(config: ExperimentConfig, command: str, expected: str) -> Run:
    """The run that a command reads, and writes its results into unless it is a pretrained model. A ConfigError where none
    is named, `expected` is what, or `out` names another folder; a CheckpointError where there is no such run.
    """
    if not config.run:
        raise ConfigError(f"run: got nothing, expected {expected}")
    run = Run.of(config)
    if not run.pretrained and config.out and Path(config.out).resolve() != run.folder.resolve():
        raise ConfigError(
            f"out: got {config.out}, expected nothing: {command} writes into run={config.run}; leave it out"
        )
    return run


def run_to_write(config: ExperimentConfig) -> Run:
    """The run that a command writes, `out` or else `run`, with a ConfigError for neither; an OutputError where the folder
    holds something else. Nothing is written yet.
    """
    folder = Path(config.out or config.run)
    if str(folder) == "." or is_pretrained(str(folder)):
        raise ConfigError("out: got nothing, expected the run folder to write, such as out=runs/first")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"out={folder}: got a file, expected a folder: choose another out=")
    # A process killed while it wrote the first file leaves its temporary name, which the next one takes.
    begun = tuple(f".{name}.tmp-" for name in ("config.json", *_KNOWN))
    found = [path for path in folder.iterdir() if not path.name.startswith(begun)] if folder.is_dir() else []
    if found and not _is_run(folder, found):
        raise OutputError(f"out={folder}: got a folder that holds something else, expected a run: choose another out=")
    return Run(folder)


def _is_run(folder: Path, found: Sequence[Path]) -> bool:
    if (folder / "meta" / "info.json").exists():
        return False  # a data set: nothing is ever written into one
    path = folder / "config.json"
    if path.is_file():  # a file that many tools write
        try:
            values = json.loads(path.read_text())
        except ValueError:
            return False
        return isinstance(values, dict) and {"preset", "env", "model"} <= values.keys()
    collected = [*(folder / "data").glob("*/meta/info.json"), *(folder / "data").glob("*.journal")]
    known = any((folder / name).exists() for name in _KNOWN)
    return bool(collected) or known or all(_is_begun(path) for path in found)


def _is_begun(stage: Path) -> bool:
    """Whether a folder is what a kill leaves of a stage that had not begun to train: empty, or with its lock."""
    return stage.is_dir() and {path.name for path in stage.iterdir()} <= {STAGE_LOCK}


def run_of_pretrained(config: ExperimentConfig, model: Run) -> Run:
    """Make `out` a run of a pretrained model: its world model's name, its policy if it has one, and this config. A
    ConfigError where `out` is missing or the model is of another task; a CheckpointError where it has another policy.
    """
    if not config.out:
        raise ConfigError(f"out: got nothing with run={config.run}, expected a folder to write, such as out=runs/check")
    run, policy = run_to_write(config), model.stage("policy") if model.has("policy") else None
    if policy is not None:
        require_task(config, policy.group(EnvConfig, "env"))
        run.require_room(policy)
    run.store(replace(config, run="", out=""))
    run.build_on(model)
    if policy is not None:
        run.take(policy)
    return run


def require_task(config: ExperimentConfig, trained: EnvConfig, names: Sequence[str] = SAME_TASK) -> None:
    """Refuse, by a ConfigError, an environment other than the one a run was trained on in one of these settings."""
    for name in names:
        got, expected = getattr(config.env, name), getattr(trained, name)
        if got != expected:
            key = "env" if name == "name" else f"env.{name}"
            raise ConfigError(
                f"{key}: got {got}, expected {expected}, with which run={config.run} was trained: leave {key}= out"
            )


def require_one_task(config: ExperimentConfig, command: str) -> None:
    """Refuse several tasks in one, by a ConfigError: a command that cannot tell a policy which."""
    if config.env.tasks:
        raise ConfigError(
            f"env.task={config.env.task}: got {len(config.env.tasks)} tasks, expected one: `playslot {command}` cannot "
            "tell a policy which; use evaluate"
        )


def require_no_goal(config: ExperimentConfig, command: str) -> None:
    """Refuse a policy that is shown goal images, by a ConfigError: a command that has none."""
    if config.model.policy.goal:
        raise ConfigError(
            f"model.policy.goal: got true in run={config.run}, expected a policy that is shown no goal images: `playslot "
            f"{command}` has none; use evaluate or plan"
        )


def require_parent(config: ExperimentConfig, run: Run, parent: StageCheckpoint, *sizes: str) -> None:
    """Check that a parent is of the task's `image_size` or `action_dim`, and that a run can build on it and has no
    other; else a CheckpointError.
    """
    from playslot_rl.storage.checkpoints import require_config

    run.require_room(parent)
    require_config(parent, {"env": {key: getattr(config.env, key) for key in sizes}})
