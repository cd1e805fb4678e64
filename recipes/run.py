"""What the training recipes share: opening a run folder and its data, and saying which device computes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import SHIPPED, shipped
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import CheckpointError, ConfigError, OutputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt
    import torch

    from playslot_rl.data.demonstrations import DemonstrationSplit
    from playslot_rl.data.source import EpisodeFrames
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.record import StageRecord

    ParsedVideos = tuple[EpisodeFrames, npt.NDArray[np.float32]]

OURS = (
    "slots",
    "dynamics",
    "policy",
    "world_model.json",
    "adopt.json",
)  # known names of a run folder without config.json


def stored_result(path: Path, facts: Mapping[str, Any]) -> dict[str, Any] | None:
    """What an evaluation wrote before, if `facts` (parts of its result) are the same; None otherwise."""
    stored: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return stored if stored and {key: stored.get(key) for key in facts} == facts else None


def existing_run(config: ExperimentConfig, command: str, cure: str) -> Path:
    """The folder of `run`, into which a command writes its results.

    Args:
        config: `run` and `out`.
        command: for the message.
        cure: how a run is made, for the message.

    Raises:
        CheckpointError: there is no such folder.
        ConfigError: `out` names another one.
    """
    run = Path(config.run)
    if not run.is_dir():
        raise CheckpointError(f"run={config.run}: no such folder, expected a run; {cure}")
    if config.out and Path(config.out).resolve() != run.resolve():
        raise ConfigError(
            f"out: got {config.out}, expected nothing: {command} writes into run={config.run}; leave it out"
        )
    return run


def open_run(config: ExperimentConfig) -> Path:
    """The folder that this command writes, `out` or else `run`. Nothing is written yet.

    Raises:
        ConfigError: neither is given.
        OutputError: the folder holds something else.
    """
    folder = Path(config.out or config.run)
    if str(folder) == "." or shipped(str(folder)):
        raise ConfigError("out: got nothing, expected the run folder to write, such as out=runs/first")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"out={folder}: got a file, expected a folder: choose another out=")
    # A process killed while it wrote the first file leaves its temporary name, which the next one takes.
    begun = tuple(f".{name}.tmp-" for name in ("config.json", *OURS))
    found = [path for path in folder.iterdir() if not path.name.startswith(begun)] if folder.is_dir() else []
    if found and not _is_run(folder):
        raise OutputError(f"out={folder}: got a folder that holds something else, expected a run: choose another out=")
    return folder


def _is_run(folder: Path) -> bool:
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
    stages = {*METHODS, *(stage for method in METHODS.values() for stage in (method.stage, method.model) if stage)}
    known = any((folder / name).exists() for name in OURS) or any(_is_begun(folder / stage) for stage in stages)
    return bool(collected) or known


def _is_begun(stage: Path) -> bool:
    """Whether a folder is what a kill leaves of a stage that had not begun to train: empty, or with its lock."""
    from playslot_rl.training.record import LOCK

    return stage.is_dir() and {path.name for path in stage.iterdir()} <= {LOCK}


def open_device(config: ExperimentConfig) -> torch.device:
    """The device that computes, after setting threads and the allocator.

    Raises:
        ConfigError: no such device.
    """
    from playslot_rl.runtime.allocator import tune_allocator
    from playslot_rl.runtime.devices import named_device, probed
    from playslot_rl.runtime.processes import own_device
    from playslot_rl.runtime.threads import set_threads

    tune_allocator()
    set_threads(config.threads)
    return probed(own_device(named_device(config.device)))


def demonstration_views(
    config: ExperimentConfig, demos: DemonstrationSplit, savi: SAVi, slots_print: str
) -> tuple[list[ParsedVideos], list[ParsedVideos]]:
    """Demonstrations and their shifted copies (`behaviour.shift`), each with the slots (F, N, D) of its frames, and the
    held-out ones, none or one, likewise; cached on disk.

    Args:
        config: of the command.
        demos: what is trained on, and what is held out.
        savi: parses the frames, on its device.
        slots_print: fingerprint of SAVi's checkpoint.
    """
    from playslot_rl.data.cache import Cache
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.data.views import shifted_copies
    from playslot_rl.world_model import module_device

    def parse(frames: EpisodeFrames) -> npt.NDArray[np.float32]:
        return slot_cache(
            frames, savi, slots_print, Cache.of(config.data), module_device(savi), config.logging.progress
        )

    def copies(of: EpisodeFrames) -> Sequence[EpisodeFrames]:
        return shifted_copies(of, config.behaviour.shift, config.behaviour.shifted_copies)

    shifted_views = [(copy, parse(of)) for copy, of in zip(copies(demos.trained), copies(demos.parsed), strict=True)]
    held_out = [] if demos.held_out is None else [(demos.held_out, parse(demos.held_out))]
    return [(demos.trained, parse(demos.parsed)), *shifted_views], held_out


def adopted_policy(config: ExperimentConfig, record: StageRecord, steps: int) -> Callable[[], None] | None:
    """What takes over the finished policy training of the run `behaviour.policy_from` names, if it is the same one."""
    from playslot_rl.training.runs import adopt_training

    source = config.behaviour.policy_from
    return partial(adopt_training, source, record.run, record.name, steps) if source else None


def cloned(
    name: str, split: DemonstrationSplit, rows: int, labelled: int | None = None, views: int = 1
) -> tuple[str, dict[str, Any]]:
    """What a stage that clones demonstrations says of them: its closing line, less its folder, and for `meta.json`.

    Args:
        name: of the stage.
        split: the demonstrations; those of one frame show nothing and are not counted.
        rows: how many of their rows trimming left.
        labelled: how many of them showed their actions; None: all.
        views: shifted copies that were cloned with them, and they themselves.
    """
    demos, kept = int((split.trained.lengths >= 2).sum()), rows / (views * int((split.trained.lengths - 1).sum()))
    shown = "all" if labelled is None else str(labelled)
    held_out = "none" if split.held_out is None else str(split.held_out.episodes)
    line = f"{name}: {demos} demos, {100 * kept:.0f} % of their rows kept, {shown} labelled, {held_out} held out"
    return line, {
        "demos": demos,
        "labelled_demos": demos if labelled is None else labelled,
        "kept_rows": round(kept, 4),
    }


def parent_run(config: ExperimentConfig, folder: Path) -> str:
    """Where a stage finds its parents: `run` if given (`pretrained` is the task's own), else the folder it writes."""
    return f"{SHIPPED}/{config.env.name}" if config.run == SHIPPED else config.run or str(folder)


def require_parent(config: ExperimentConfig, run: Path, parent: StageCheckpoint, *sizes: str) -> None:
    """Check that a parent is of the task's `image_size` or `action_dim`, and that `run` can build on it.

    Raises:
        CheckpointError: it is of others, or `run` has another one of its own.
    """
    from playslot_rl.storage.checkpoints import require_config
    from playslot_rl.training.runs import require_adoptable

    require_adoptable(parent, run)
    require_config(parent, {"env": {key: getattr(config.env, key) for key in sizes}})
