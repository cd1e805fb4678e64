"""What the training recipes share: opening a run folder and its data, and saying which device computes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import SHIPPED, shipped
from playslot_rl.errors import ConfigError, DataError, OutputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import torch

    from playslot_rl.data.demonstrations import DemonstrationSplit
    from playslot_rl.data.source import EpisodeFrames
    from playslot_rl.modules.savi import SAVi

    ParsedVideos = tuple[EpisodeFrames, npt.NDArray[np.float32]]

OURS = ("slots", "dynamics", "policy", "world_model.json")  # known names of a run folder without config.json


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
    if folder.is_dir() and any(folder.iterdir()) and not _is_run(folder):
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
    return bool(collected) or any((folder / known).exists() for known in OURS)


def store_config(config: ExperimentConfig, folder: Path) -> None:
    """Write the run's config. Called when everything fits, so that a refused command leaves the stored one as it was.

    Raises:
        OutputError: the folder cannot be written.
    """
    from playslot_rl.storage.atomic import write_json

    write_json(folder / "config.json", to_dict(config))


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
    """Open the data sets of a stage; of `data.demos` among several, not the demonstrations that are held out.

    Raises:
        DataError: none is named, or one cannot be read.
    """
    from playslot_rl.data.demonstrations import episode_range
    from playslot_rl.data.source import concatenate, open_sources

    def opened(root: str) -> EpisodeFrames:
        size, resize = config.env.image_size, config.data.resize
        return open_sources(root, config.data.camera, config.data.cache, image_size=size, resize=resize)

    if not roots:
        raise DataError(f"{what}: got no data set, expected data.root=DIR; record one by `playslot collect`")
    names = [name.strip() for name in roots.split(",")]
    if not config.data.held_out or config.data.demos not in names or len(names) == 1:
        return opened(roots)
    parts = {name: opened(name) for name in names}
    demos = parts[config.data.demos]
    parts[config.data.demos] = episode_range(demos, 0, demos.episodes - config.data.held_out)
    return concatenate([parts[name] for name in names])


def demo_root(config: ExperimentConfig) -> str:
    """Data set of the demonstrations: `data.demos`, or else `data.root`."""
    return config.data.demos or config.data.root


def open_demonstrations(config: ExperimentConfig, what: str) -> DemonstrationSplit:
    """The demonstrations a stage trains on, and those that only measure.

    Raises:
        DataError: none are named, they cannot be read, or there are fewer than `demos`.
    """
    from playslot_rl.data.demonstrations import split_demonstrations

    videos = open_videos(config, demo_root(config), what)
    return split_demonstrations(videos, config.demos, config.data.held_out, config.collect.validation_episodes)


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
    from playslot_rl.data.shifted import shifted_copies
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.world_model import module_device

    def parse(frames: EpisodeFrames) -> npt.NDArray[np.float32]:
        return slot_cache(frames, savi, slots_print, config.data.cache, module_device(savi), config.logging.progress)

    copies = shifted_copies(demos.trained, config.behaviour.shift, config.behaviour.shifted_copies)
    held_out = [] if demos.held_out is None else [(demos.held_out, parse(demos.held_out))]
    return [(demos.trained, parse(demos.parsed)), *((copy, parse(copy)) for copy in copies)], held_out


def held_out_text(demos: DemonstrationSplit) -> str:
    """For a closing line: how many demonstrations measured what was learned from the others."""
    return "none held out" if demos.held_out is None else f"{demos.held_out.episodes} held out"


def parent_run(config: ExperimentConfig, folder: Path) -> str:
    """Where a stage finds its parents: `run` if given (`pretrained` is the task's own), else the folder it writes."""
    return f"{SHIPPED}/{config.env.name}" if config.run == SHIPPED else config.run or str(folder)
