"""What the training recipes share: opening a run folder and its data, and saying which device computes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import SHIPPED, shipped
from playslot_rl.config.roles import fixed_keys as fixed_keys
from playslot_rl.errors import ConfigError, DataError, OutputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import torch

    from playslot_rl.data.source import EpisodeFrames
    from playslot_rl.modules.savi import SAVi

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
    """Open the data sets of a stage.

    Raises:
        DataError: none is named, or one cannot be read.
    """
    from playslot_rl.data.source import open_sources

    if not roots:
        raise DataError(f"{what}: got no data set, expected data.root=DIR; record one by `playslot collect`")
    return open_sources(
        roots, config.data.camera, config.data.cache, image_size=config.env.image_size, resize=config.data.resize
    )


def demo_root(config: ExperimentConfig) -> str:
    """Data set of the demonstrations: `data.demos`, or else `data.root`."""
    return config.data.demos or config.data.root


def demonstration_views(
    config: ExperimentConfig, videos: EpisodeFrames, source: EpisodeFrames, savi: SAVi, slots_print: str
) -> Sequence[tuple[EpisodeFrames, npt.NDArray[np.float32]]]:
    """Demonstrations and their shifted copies (`behaviour.shift`), each with the slots of its frames, cached on disk.

    Args:
        config: of the command.
        videos: the data set.
        source: the demonstrations, the first episodes of it.
        savi: parses the frames, on its device.
        slots_print: fingerprint of SAVi's checkpoint.
    """
    from playslot_rl.data.shifted import parsed_views
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.world_model import module_device

    def parse(frames: EpisodeFrames) -> npt.NDArray[np.float32]:
        return slot_cache(frames, savi, slots_print, config.data.cache, module_device(savi), config.logging.progress)

    return parsed_views(videos, source, config.behaviour.shift, config.behaviour.shifted_copies, parse)


def parent_run(config: ExperimentConfig, folder: Path) -> str:
    """Where a stage finds its parents: `run` if given (`pretrained` is the task's own), else the folder it writes."""
    return f"{SHIPPED}/{config.env.name}" if config.run == SHIPPED else config.run or str(folder)


def finished(
    config: ExperimentConfig,
    folder: Path,
    stage: str,
    wanted: Mapping[str, Any],
    parents: Mapping[str, Any],
    roots: str,
    demos: int | None = None,
) -> bool:
    """Whether a stage of a run is finished; if so, say that it is skipped.

    Args:
        wanted: parts of the config that the checkpoint must have been trained with.
        parents: checkpoints it must have been trained on, by stage.
        roots: data sets it must have been trained on; empty if the command names none.
        demos: first episodes of them that it must have been trained on; None means all.

    Raises:
        CheckpointError: it was trained otherwise.
    """
    from playslot_rl.data.demonstrations import first_demonstrations
    from playslot_rl.errors import CheckpointError
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config, require_parents

    path = checkpoint_folder(folder, stage)
    if not (path / "meta.json").is_file():
        return False
    done = read_stage(path, stage)
    require_parents(done, parents)
    require_config(done, wanted)
    facts: list[tuple[str, object, object]] = [("seed", config.seed, done.meta.get("seed", config.seed))]
    if roots:
        data = next(iter(done.meta["data"].values()), "none")
        source = first_demonstrations(open_videos(config, roots, stage), demos)
        facts.append(("data", source.fingerprint, data))
    for name, got, old in facts:
        if got != old:
            raise CheckpointError(f"{name}: got {got}, expected {old} as {path} was trained with: use another out=")
    print(f"{stage}: finished before ({done.meta.get('steps')} steps), skipped", flush=True)
    return True
