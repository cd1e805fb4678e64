"""Finished stages: `weights.safetensors`, `config.json` and `meta.json` in a folder. Never a pickle.

A child names its parents by the fingerprints of their weights and refuses any other. Where the folders lie in a run:
`playslot_rl.runs`.
"""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn

from playslot_rl.config import EnvConfig, ModelConfig, from_dict
from playslot_rl.config.methods import METHODS
from playslot_rl.config.plain import flatten
from playslot_rl.errors import CheckpointError
from playslot_rl.runtime.devices import processor
from playslot_rl.runtime.precision import native_bf16
from playslot_rl.storage.atomic import read_json, write_json
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.resume import first_difference
from playslot_rl.storage.tensors import load_modules, load_tensors, module_tensors, save_tensors, weights_fingerprint

FORMAT = "playslot_rl.checkpoint/1"
STAGES = ("slots", "dynamics", "policy")


def training_command(stage: str) -> str:
    """The command that trains a stage."""
    if stage in STAGES:
        return f"train-{stage}"
    methods = [name for name, method in METHODS.items() if stage in (part.name for part in method.stages)]
    return f"train-baseline method={stage if stage in methods or not methods else methods[0]}"


@dataclass(frozen=True)
class StageCheckpoint:
    """A finished stage on disk: the plain values it was trained with, `{"env": ..., "model": ..., STAGE: ...}`; how it
    was made; and the fingerprint of its weights, the first 16 hex digits of their SHA-256.
    """

    path: Path
    stage: str
    config: dict[str, Any]
    meta: dict[str, Any]
    fingerprint: str

    def group[Group](self, cls: type[Group], name: str) -> Group:
        """A group of the config it was trained with; all stages store `env`. A CheckpointError where this version has
        no such one.
        """
        try:
            return from_dict(cls, self.config[name], f"{name}.")
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{self.path}/config.json: {error}; expected the {name} of this version of playslot_rl: train that "
                "stage again"
            ) from error

    @property
    def sizes(self) -> tuple[ModelConfig, EnvConfig]:
        """The groups `model` and `env`. Raises CheckpointError: its config.json is not one of this version."""
        return self.group(ModelConfig, "model"), self.group(EnvConfig, "env")

    def restore[Network: nn.Module](
        self, build: Callable[[], Network], parts: str | Sequence[str], device: torch.device | str = "cpu"
    ) -> Network:
        """A network with the stored weights, in evaluation mode, without gradients; the global generator is as before.

        Args:
            build: makes it anew.
            parts: the name that the whole network is stored under, or those of its attributes that are stored.
        """
        with torch.random.fork_rng(devices=[]):
            network = build()
        whole: dict[str, nn.Module] = {parts: network} if isinstance(parts, str) else {}
        load_weights(self, whole or {name: getattr(network, name) for name in parts})
        return network.to(device).eval().requires_grad_(False)

    def restore_several[*Networks](
        self, names: Sequence[str], build: Callable[[], tuple[*Networks]], device: torch.device | str = "cpu"
    ) -> tuple[*Networks]:
        """As `restore`, of networks that are stored side by side under these names."""
        with torch.random.fork_rng(devices=[]):
            networks = build()
        modules = dict(zip(names, cast(tuple[nn.Module, ...], networks), strict=True))
        load_weights(self, modules)
        for module in modules.values():
            module.to(device).eval().requires_grad_(False)
        return networks


def checkpoint_folder(run: Path, stage: str) -> Path:
    """`RUN/STAGE/checkpoint`."""
    return run / stage / "checkpoint"


def save_stage(
    path: Path,
    *,
    stage: str,
    modules: Mapping[str, nn.Module],
    config: Mapping[str, Any],
    data: Mapping[str, str],
    parents: Mapping[str, str],
    metrics: Mapping[str, float],
    steps: int,
    seconds: float,
    extra: Mapping[str, Any] | None = None,
) -> StageCheckpoint:
    """Write a finished stage, atomically, to a folder that is replaced if it exists.

    Args:
        modules: what to store, by name.
        config: as of a `StageCheckpoint`.
        data: fingerprints of the data sets, by role (`train`, `demos`).
        parents: fingerprints of the parents' weights, by stage.
        extra: more plain values for `meta.json` (`labelled_demos`, `demos`).
    """
    with new_folder(path, replace=True) as temporary:
        save_tensors(temporary / "weights.safetensors", module_tensors(modules))
        fingerprint = weights_fingerprint(temporary / "weights.safetensors")
        meta = {
            "format": FORMAT,
            "stage": stage,
            "fingerprint": fingerprint,
            "modules": sorted(modules),
            "data": dict(data),
            "parents": dict(parents),
            "metrics": dict(metrics),
            "steps": steps,
            "seconds": round(seconds, 1),
            **provenance(),
            **(extra or {}),
        }
        write_json(temporary / "config.json", dict(config))
        write_json(temporary / "meta.json", meta)
    return StageCheckpoint(path, stage, dict(config), meta, fingerprint)


def read_stage(path: Path, stage: str) -> StageCheckpoint:
    """A finished stage, without its weights; a CheckpointError where it is none, of another stage or format, or
    damaged.
    """
    if not (path / "meta.json").is_file():
        raise CheckpointError(
            f"no {stage} checkpoint at {path}, expected meta.json, config.json and weights.safetensors: "
            f"run `playslot {training_command(stage)}` first, or check run="
        )
    meta, config = read_json(path / "meta.json"), read_json(path / "config.json")
    if meta.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: got format {meta.get('format')!r}, expected {FORMAT!r}: "
            "use the version of playslot_rl that wrote it"
        )
    if meta.get("stage") != stage:
        raise CheckpointError(
            f"{path}: got a checkpoint of stage {meta.get('stage')!r}, expected {stage!r}: check run="
        )
    weights = path / "weights.safetensors"
    if not weights.is_file():
        raise CheckpointError(
            f"{weights} is missing, expected the stage's weights: delete {path} and train {stage} again"
        )
    return StageCheckpoint(path, stage, config, meta, weights_fingerprint(weights))


def load_weights(checkpoint: StageCheckpoint, modules: Mapping[str, nn.Module]) -> None:
    """Load a finished stage into freshly built modules, in place; a CheckpointError where a tensor is missing,
    unexpected or of another shape, or the file is not the one that was saved.
    """
    load_modules(modules, load_tensors(checkpoint.path / "weights.safetensors"), str(checkpoint.path))
    require_whole(checkpoint)


def require_whole(checkpoint: StageCheckpoint) -> None:
    """Check that the weights are the ones that were saved. Raises CheckpointError: they are not."""
    saved = checkpoint.meta.get("fingerprint")
    if checkpoint.fingerprint != saved:
        raise CheckpointError(
            f"{checkpoint.path / 'weights.safetensors'}: got fingerprint {checkpoint.fingerprint}, expected {saved} "
            f"from its meta.json: the file was changed or damaged; put it back, or delete {checkpoint.path} and run "
            f"`playslot {training_command(checkpoint.stage)}` again"
        )


def require_parents(child: StageCheckpoint, parents: Mapping[str, StageCheckpoint]) -> None:
    """Check that a child was trained on exactly these parents, and that they are whole; else a CheckpointError."""
    for name, parent in parents.items():
        require_whole(parent)
        expected = child.meta.get("parents", {}).get(name)
        if parent.fingerprint != expected:
            raise CheckpointError(
                f"{child.path} was trained on {name} {expected}, got {name} {parent.fingerprint} at {parent.path}: "
                f"run `playslot {training_command(child.stage)}` again on these, or put its parent back"
            )


def require_config(checkpoint: StageCheckpoint, wanted: Mapping[str, Any], typed: Callable[[str], str] = str) -> None:
    """Check that the parts of a config in `wanted`, such as `{"model": {"savi": ...}}`, are those of a checkpoint; a
    CheckpointError names the first key that differs, as `typed` (see `first_difference`).
    """
    stored, keys = flatten(checkpoint.config), set(flatten(wanted))
    for group, key in (("env.", "env.name"), ("model.savi.", "model.savi.n_slots")):
        if key in keys:  # the whole task or SAVi, also what is not said of it
            keys |= {name for name in stored if name.startswith(group)}
    difference = first_difference({key: stored[key] for key in stored.keys() & keys}, wanted, typed)
    if difference is not None:
        key, old, new = difference
        raise CheckpointError(
            f"{key}: got {new}, expected {old}, with which {checkpoint.path} was trained: "
            f"leave {key} as it was, or use another out="
        )


def provenance() -> dict[str, Any]:
    """What made a checkpoint: version, commit, command line, Python, torch and processor."""
    from playslot_rl import __version__

    return {
        "version": __version__,
        "commit": source_commit(),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {'' if native_bf16('cpu') else 'no '}bf16",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "",
        "processor": processor(),
    }


def source_commit() -> str:
    """Commit of this source tree, with `-dirty` if it has changes; empty where it is no git checkout."""
    folder = Path(__file__).resolve().parents[1]
    if not (folder.parent / ".git").exists():
        return ""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=20)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        commit = git("rev-parse", "HEAD")
        return f"{commit}-dirty" if commit and git("status", "--porcelain", "--untracked-files=no") else commit
    except (OSError, subprocess.TimeoutExpired):
        return ""
