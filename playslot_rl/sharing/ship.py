"""A run's model as it ships: its stages without what training left, weights in half precision.

    python -m playslot_rl.sharing.ship runs/compact playslot_rl/pretrained/ENV

    w' = fp16(w), |w' - w| <= 2^-11 |w| for 6e-5 <= |w| <= 65,504

They are loaded as fp32. The stages get new fingerprints, and the children name their parents by these, so a model is
written as a whole, and policies trained on the one before are refused.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.checkpoints import STAGES, StageCheckpoint, checkpoint_folder, read_stage, require_whole
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.tensors import load_tensors, save_tensors, weights_fingerprint


def ship(run: Run, target: Path) -> list[StageCheckpoint]:
    """Write the stages of a run, and of the world model that it builds on, in half precision; what of them `target` has
    is replaced. A CheckpointError where one is missing, damaged, or was trained on other parents.
    """
    stages, written = [run.stage(name) for name in STAGES], dict[str, StageCheckpoint]()
    for stage in stages:  # before the first is written
        require_whole(stage)
    for stage in stages:
        path, tensors = checkpoint_folder(target, stage.stage), load_tensors(stage.path / "weights.safetensors")
        with new_folder(path, replace=True) as temporary:
            save_tensors(temporary / "weights.safetensors", {key: halved(value) for key, value in tensors.items()})
            own = {
                "fingerprint": weights_fingerprint(temporary / "weights.safetensors"),
                "parents": {name: written[name].fingerprint for name in stage.meta["parents"]},
                "halved_from": stage.fingerprint,
            }
            write_json(temporary / "config.json", stage.config)
            write_json(temporary / "meta.json", {**stage.meta, **own})
        written[stage.stage] = read_stage(path, stage.stage)
    return list(written.values())


def halved(value: Tensor) -> Tensor:
    """fp32 as fp16, but for tensors that do not fit into its range; all else as it is."""
    half = value.half()
    return half if value.dtype == torch.float32 and bool(half.isfinite().all()) else value


def main(arguments: list[str]) -> None:
    """RUN and FOLDER; a ConfigError for other arguments, or a folder that is the run's or lies in it."""
    run = Run.open(arguments[0]) if len(arguments) == 2 else None
    if run is None or Path(arguments[1]).resolve().is_relative_to(run.folder.resolve()):
        raise ConfigError(
            f"got {' '.join(arguments) or 'nothing'}, expected a run and another folder to write, outside of it"
        )
    for stage in ship(run, Path(arguments[1])):
        size = (stage.path / "weights.safetensors").stat().st_size
        print(f"{stage.path}: {size / 1e6:.1f} MB, {stage.fingerprint}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except PlaySlotError as error:
        sys.exit(f"ship: error: {error}")
