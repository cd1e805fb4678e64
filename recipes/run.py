"""What the training recipes share: opening a run folder and its data, and saying which device computes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.errors import ConfigError, DataError, OutputError

if TYPE_CHECKING:
    import torch

    from playslot_rl.data.source import EpisodeFrames

OURS = ("config.json", "data", "slots", "dynamics", "policy", "evaluation", "figures")
"""Names by which a run folder is known."""


def open_run(config: ExperimentConfig) -> Path:
    """Make or open the folder that this command writes, `out` or else `run`, and store the config in it.

    Raises:
        ConfigError: neither is given.
        OutputError: the folder holds something else, or cannot be written.
    """
    from playslot_rl.training.atomic import explain_write_errors, write_json

    name = config.out or config.run
    if not name or name == "pretrained":
        raise ConfigError("out: got nothing, expected the run folder to write, such as out=runs/first")
    folder = Path(name)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"out={folder}: got a file, expected a folder: choose another out=")
    if folder.is_dir() and any(folder.iterdir()) and not any((folder / known).exists() for known in OURS):
        raise OutputError(f"out={folder}: got a folder that holds something else, expected a run: choose another out=")
    with explain_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "config.json", to_dict(config))
    return folder


def open_device(config: ExperimentConfig) -> torch.device:
    """The device that computes, after setting threads and the allocator.

    Raises:
        ConfigError: no such device.
    """
    import torch

    from playslot_rl.allocator import tune_allocator
    from playslot_rl.threads import set_threads

    tune_allocator()
    set_threads(config.threads)
    try:
        device = torch.device(config.device or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device={config.device}: {str(error).splitlines()[0]}; use device=cpu") from error
    return device


def open_videos(config: ExperimentConfig, roots: str, what: str) -> EpisodeFrames:
    """Open the data sets of a stage.

    Raises:
        DataError: none is named, or one cannot be read.
    """
    from playslot_rl.data.source import open_sources

    if not roots:
        raise DataError(f"{what}: got no data set, expected data.root=DIR; record one by `playslot collect`")
    return open_sources(roots, config.data.camera, config.data.cache, image_size=config.env.image_size)


def demo_root(config: ExperimentConfig) -> str:
    """Data set of the demonstrations: `data.demos`, or else `data.root`."""
    return config.data.demos or config.data.root


def parent_run(config: ExperimentConfig, folder: Path) -> str:
    """Where a stage finds its parents: `run` if given (a folder or `pretrained`), else the folder it writes."""
    return config.run or str(folder)


def said(stage: str, folder: Path) -> bool:
    """Whether a stage is finished; if so, say that it is skipped."""
    meta = folder / stage / "checkpoint" / "meta.json"
    if not meta.is_file():
        return False
    print(f"{stage}: finished before ({json.loads(meta.read_text()).get('steps')} steps), skipped", flush=True)
    return True
