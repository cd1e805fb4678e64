"""What every stage of every method is identified by, in a form that can be kept and compared.

Nothing is trained: `planned` takes each recipe up to its `StageRecord`, `begun` up to the checkpoints of its parts.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import nn

from playslot_rl.config.compose import compose
from playslot_rl.config.plain import flatten
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import PlaySlotError
from playslot_rl.recipes import train_baseline, train_dynamics, train_policy, train_slots
from playslot_rl.storage import checkpoints
from playslot_rl.storage.resume import TrainingCheckpoints, TrainingState
from playslot_rl.training import record as records
from playslot_rl.training.record import StageRecord

BASELINES = (
    "slot_oracle", "resnet_oracle", "lapo", "lapo_slots", "laom", "clam", "dreamer", "sold", "caddy_policy",
    "caddy_oracle", "svg", "caddy", "slotformer", "ocvp_seq", "act", "diffusion", "autoencoder_bc",
    "inverse_bc", "history_bc", "act_state", "diffusion_state", "slot_vpt",
)  # fmt: skip
ON_A_MODEL = {
    "lapo": "lapo_model",
    "laom": "laom_model",
    "clam": "clam_model",
    "caddy_policy": "caddy",
    "caddy_oracle": "caddy",
    "autoencoder_bc": "autoencoder",
    "inverse_bc": "inverse_resnet",
}
WHOLE = ("button_press", "compact")
"""Task and preset that are written out; the others only where they differ."""
OTHERS = (
    ("button_press", "paper"), ("block_push", "compact"), ("block_pick", "paper"), ("grid_shapes", "compact"),
    ("sketchy", "compact"), ("video", "compact"),
)  # fmt: skip
VARIANTS: Mapping[str, tuple[str, ...]] = {
    "plain": (),
    "options": (
        "slots.patience=2", "slots.zoom_steps=1", "slots.motion_weight=0.5", "dynamics.patience=1",
        "behaviour.whiten=false", "behaviour.decoder_state=false", "behaviour.finetune_steps=0",
        "behaviour.trim_pixels=0.01", "baselines.resnet_oracle.patience=2", "baselines.lapo.targets=quantised",
        "baselines.sold.savi_steps=100", "baselines.slotformer.patience=1", "data.held_out=2", "seed=3",
        "dynamics.precision=auto", "baselines.dreamer.workers=2", "logging.backend=none",
    ),
    "ground_truth": ("model.inverse_dynamics.mode=ground_truth",),
}  # fmt: skip
"""Options with which the parts of the smoke preset are begun."""


class _BuiltError(Exception):
    """An online training has been built."""


@dataclass
class Seen:
    """Records by stage, identities of parts' checkpoints by folder, and what was refused."""

    records: dict[str, StageRecord] = field(default_factory=dict)
    identities: dict[str, dict[str, Any]] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)


def few_videos(image_size: int, action_dim: int) -> EpisodeFrames:
    """Eight episodes of eight frames in which a square jumps, with actions and proprioception."""
    numbers, rows = np.random.default_rng(0), 64
    frames = np.full((rows, image_size, image_size, 3), 40, np.uint8)
    for row in range(rows):
        at = 4 * (row % 8)
        frames[row, at : at + 8, at : at + 8] = (220, 60, 60)
    return EpisodeFrames(
        frames=frames, starts=np.arange(8) * 8, lengths=np.full(8, 8),
        actions=numbers.uniform(-1, 1, (rows, action_dim)).astype(np.float32),
        seeds=np.arange(8), fingerprint="data", fps=10.0, task="", camera="",
        states=numbers.normal(size=(rows, 4)).astype(np.float32),
    )  # fmt: skip


class _Named(nn.Module):
    """Weights whose fingerprint says their stage, on every machine."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.register_buffer("name", torch.tensor(list(name.encode()), dtype=torch.uint8))


def planned(env: str, preset: str, folder: Path) -> Seen:
    """Records of all stages of a task with a preset; the parents' weights are their names."""
    seen = Seen()

    def finished(record: StageRecord) -> Any:
        seen.records[record.name] = record
        if record.role:
            _ = record.data  # opened while it can be
        return record.save({"name": _Named(record.name)}, {}, 1, 0.0, {"agent_steps": 1})

    with patch.object(StageRecord, "finished", finished), on_few_videos():
        _run_all(seen, folder, [f"env={env}", f"preset={preset}", "demos=4", "behaviour.labelled_demos=2"])
    return seen


def begun(options: tuple[str, ...], folder: Path) -> Seen:
    """Records and parts of all stages of the smoke preset, each saved as it was built."""
    seen = Seen()
    plain_init, plain_finished = TrainingCheckpoints.__init__, StageRecord.finished

    def init(self: TrainingCheckpoints, where: Path, identity: Mapping[str, Any], *more: Any) -> None:
        plain_init(self, where, identity, *more)
        seen.identities[where.parent.relative_to(folder).as_posix()] = self.identity
        if type(self) is not TrainingCheckpoints:
            raise _BuiltError

    def finished(record: StageRecord) -> Any:
        seen.records[record.name] = record
        return plain_finished(record)

    def resume(self: TrainingCheckpoints, *_: Any) -> TrainingState:
        return TrainingState(step=10**9)

    with (
        patch.object(TrainingCheckpoints, "__init__", init),
        patch.object(TrainingCheckpoints, "resume", resume),
        patch.object(StageRecord, "finished", finished),
        on_few_videos(),
    ):
        _run_all(seen, folder, ["env=button_press", "preset=smoke", f"data.cache={folder / 'cache'}", *options])
    return seen


@contextlib.contextmanager
def on_few_videos() -> Iterator[None]:
    """Inside the block stages are trained on `few_videos`."""

    def open_videos(config: Any, *_: str) -> EpisodeFrames:
        return few_videos(config.env.image_size, config.env.action_dim)

    quick = patch.object(checkpoints, "provenance", dict)  # git takes longer than all the rest
    with patch.object(records, "open_videos", open_videos), quick:
        yield


def _run_all(seen: Seen, folder: Path, arguments: list[str]) -> None:
    world, shared = folder / "world", [*arguments, "data.root=videos", "device=cpu"]
    for recipe in (train_slots, train_dynamics, train_policy):
        recipe.main(compose([*shared, f"out={world}"]))
    for method in BASELINES:
        model = ON_A_MODEL.get(method)
        built = [f"baselines.{method}.world={folder / model}"] if model and (folder / model).is_dir() else []
        own = [f"method={method}", f"out={folder / method}", f"run={world}"]
        try:
            train_baseline.main(compose([*shared, *own, *built]))
        except _BuiltError:
            pass
        except PlaySlotError:
            seen.refused.append(method)


def identities(seen: Seen, prints: bool) -> dict[str, Any]:
    """Flat, plain values of what was seen; parents by their names where their fingerprints differ by machine."""
    values: dict[str, Any] = {"refused": sorted(seen.refused)}
    names = {value: f"<{name}>" for record in seen.records.values() for name, value in record.prints.items()}
    for name, record in sorted(seen.records.items()):
        stored = json.dumps(record.stored, sort_keys=True)
        values[name] = {
            "resumes": flatten(record.resumes()),
            "finishes": flatten(record.finishes()),
            "stored": hashlib.sha256(stored.encode()).hexdigest()[:16],
        }
    for folder, identity in sorted(seen.identities.items()):
        values[f"{folder}/checkpoints"] = flatten(identity)
    text = json.dumps(values)
    for value, name in {} if prints else names.items():
        text = text.replace(value, name)
    plain: dict[str, Any] = json.loads(text)
    return plain


def differences(base: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """What of nested values is another one than in the base; what is gone is `null`."""
    found: dict[str, Any] = {}
    for key in sorted({*base, *other}):
        left, right = base.get(key), other.get(key)
        if isinstance(left, Mapping) and isinstance(right, Mapping):
            inside = differences(left, right)
            if inside:
                found[key] = inside
        elif left != right:
            found[key] = right
    return found


def stage_identities(folder: Path) -> dict[str, Any]:
    """Everything that `stages.json` holds."""
    whole = identities(planned(*WHOLE, folder / "-".join(WHOLE)), prints=True)
    values = {"planned": {"-".join(WHOLE): whole}, "begun": {}}
    for pair in OTHERS:
        other = identities(planned(*pair, folder / "-".join(pair)), prints=True)
        values["planned"]["-".join(pair)] = differences(whole, other)
    first: dict[str, Any] = {}
    for name, options in VARIANTS.items():
        found = identities(begun(options, folder / name), prints=False)
        values["begun"][name] = differences(first, found)
        first = first or found
    return values
