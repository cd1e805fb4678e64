"""Training checkpoints: what a stage resumes from. Folders `step_XXXXXXXX` of safetensors and JSON, whole or absent.

A folder appears by one rename after everything in it is on the disk, so the newest one is always good. The newest two
are kept. No RNG state is stored: every draw is a function of the seed and the step (`seeding`).

Note: optimisers are not stored by torch.distributed's `get_optimizer_state_dict`: where a parameter never had a
gradient it steps with zeros to make a state, which a resumed run would then have and an uninterrupted one would not.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.plain import flatten
from playslot_rl.config.roles import earlier, keys_of
from playslot_rl.errors import CheckpointError, OutputError
from playslot_rl.runtime.devices import device_name
from playslot_rl.storage.atomic import json_or_nothing, read_json, write_json
from playslot_rl.storage.folders import copy_files, new_folder, remove_leftovers
from playslot_rl.storage.tensors import load_into, load_modules, load_tensors, module_tensors, save_tensors

FORMAT = "playslot_rl.training/1"
KEPT = 2

_ABSENT = "nothing"


@dataclass(frozen=True)
class TrainingState:
    """Where a stage stands: steps, wall-clock seconds spent on them over all processes, and the last validation's
    numbers.

    Attributes:
        best: those of the best validation, where a training stops early; else empty.
        stale: validations since then.
        planned: steps that it ends after, where the clock has changed them; 0 leaves those of its config.
        precision: `fp32` or `bf16`, in which it began; `auto` where nobody knows.
    """

    step: int = 0
    seconds: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    best: dict[str, float] = field(default_factory=dict)
    stale: int = 0
    planned: int = 0
    precision: str = "auto"


def first_difference(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], typed: Callable[[str], str] = str
) -> tuple[str, Any, Any] | None:
    """The first dotted key at which two nested configs differ: (key as it is typed, stored value, wanted value).

    A wanted precision of `auto` is equal to any that was stored, a key of the machine to any, so is the place of what
    a training started from where both say what that was (`started_from`), and so is the camera of what does not say
    its own. A key that came after what is stored counts as what was computed without it
    (`playslot_rl.config.roles.was`). `typed` makes of a key as it is stored the full name under which it is typed.
    """
    right, known = flatten(wanted), earlier(ExperimentConfig)
    left = {**{key: known[typed(key)] for key in right if typed(key) in known}, **flatten(stored)}
    places = keys_of(ExperimentConfig, "machine")
    if "started_from" in left.keys() & right.keys():
        places |= {"slots.start_from"}
    if "data.camera" not in left:  # checkpoints of before did not say it
        places |= {"data.camera"}
    for key in sorted(left.keys() | right.keys()):
        if typed(key) in places:
            continue
        if key.rpartition(".")[-1] == "precision" and right.get(key) == "auto":
            continue  # whatever this processor is good at: a run goes on on another one
        if left.get(key, _ABSENT) != right.get(key, _ABSENT):
            return typed(key), left.get(key, _ABSENT), right.get(key, _ABSENT)
    return None


class TrainingCheckpoints:
    """The `checkpoints` folder of a stage, whose `identity`, nested plain values, must be equal for a resumed run to be
    the same run. Saving on a full disk raises an OutputError; the earlier checkpoints stay.

    Attributes:
        sittings: what each process before this one added: `steps`, `seconds` and the `device`. Steps that were lost
            with a kill count nowhere.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any], typed: Callable[[str], str] = str) -> None:
        self.folder, self.typed = folder, typed
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))
        self.sittings: list[dict[str, Any]] = []

    def saved(self) -> list[Path]:
        """Checkpoint folders, oldest first."""
        return sorted(self.folder.glob("step_*"))

    def last(self) -> Path | None:
        """The newest checkpoint, or None."""
        saved = self.saved()
        return saved[-1] if saved else None

    def take(self, source: Path) -> None:
        """Copy another run's checkpoint, unless it is of another training or there is one here."""
        stored = json_or_nothing(source / "state.json")
        same = stored.get("format", FORMAT) == FORMAT and "identity" in stored
        if same and not self.folder.exists() and self._difference(stored) is None:
            copy_files(source, self.folder / source.name)

    def save(
        self,
        state: TrainingState,
        modules: Mapping[str, nn.Module],
        optimizer: torch.optim.Optimizer,
        parameters: Mapping[str, nn.Parameter],
        average: Mapping[str, Tensor] | None = None,
    ) -> Path:
        """Write a checkpoint, with an average of the weights if there is one, and remove all but the newest two."""
        tensors = {"modules": module_tensors(modules), "optimizer": optimizer_tensors(optimizer, list(parameters))}
        return self._write(state.step, tensors | ({"average": average} if average else {}), asdict(state))

    def resume(
        self,
        modules: Mapping[str, nn.Module],
        optimizer: torch.optim.Optimizer,
        parameters: Mapping[str, nn.Parameter],
        average: Mapping[str, Tensor] | None = None,
    ) -> TrainingState:
        """Load the newest checkpoint into the modules, the optimiser and the average of the weights, if there is one; a
        fresh `TrainingState` if there is no checkpoint. A CheckpointError where its config is another or it is damaged.
        """
        newest = self._newest()
        if newest is None:
            return TrainingState()
        last, stored = newest
        load_modules(modules, load_tensors(last / "modules.safetensors"), str(last))
        restore_optimizer(optimizer, load_tensors(last / "optimizer.safetensors"), str(last), list(parameters))
        if average:
            load_into(average, load_tensors(last / "average.safetensors"), str(last))
        best, stale, planned = stored.get("best", {}), stored.get("stale", 0), stored.get("planned", 0)
        begun = next(
            (value for key, value in flatten(stored["identity"]).items() if key.endswith(".precision")), "auto"
        )
        precision = stored.get("precision", begun)
        return TrainingState(stored["step"], stored["seconds"], stored["metrics"], best, stale, planned, precision)

    def _write(self, step: int, files: Mapping[str, Mapping[str, Tensor]], state: Mapping[str, Any]) -> Path:
        """Write `step_STEP` of tensors `NAME.safetensors` and a `state.json`; keep the newest two."""
        final = self.folder / f"step_{step:08d}"
        with new_folder(final, replace=True) as temporary:
            for name, tensors in files.items():
                save_tensors(temporary / f"{name}.safetensors", tensors)
            device = next((value.device for value in files["modules"].values()), torch.device("cpu"))
            own = {
                "steps": step - sum(sitting["steps"] for sitting in self.sittings),
                "seconds": state["seconds"] - sum(sitting["seconds"] for sitting in self.sittings),
                "device": device_name(device),
            }
            kept = {"identity": self.identity, "sittings": [*self.sittings, own]}
            write_json(temporary / "state.json", {"format": FORMAT, **state, **kept})
        for old in self.saved()[:-KEPT]:
            shutil.rmtree(old)
        return final

    def _difference(self, stored: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
        return first_difference(stored["identity"], self.identity, self.typed)

    def _newest(self) -> tuple[Path, dict[str, Any]] | None:
        """The newest checkpoint and its `state.json`, checked to belong to this run; None if there is none."""
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder} is a file, expected a folder of checkpoints: use another out=")
        # A killed process leaves its unfinished folder; that of one that is writing is left alone.
        remove_leftovers(self.folder, "step_*")
        last = self.last()
        if last is None:
            return None
        path, cure = last / "state.json", f"delete {last.name} to resume from the checkpoint before it"
        stored = read_json(path, cure)
        if stored.get("format", FORMAT) != FORMAT:
            raise CheckpointError(
                f"{last}: got format {stored['format']!r}, expected {FORMAT!r}: "
                "use the version of playslot_rl that wrote it, or another out="
            )
        missing = {"format", "step", "seconds", "metrics", "identity"} - stored.keys()
        if missing:
            raise CheckpointError(f"{path} is damaged (no {', '.join(sorted(missing))}): {cure}")
        difference = self._difference(stored)
        if difference is not None:
            key, old, new = difference
            raise CheckpointError(
                f"{key}: got {new}, expected {old}, with which {self.folder.parent} was begun: "
                f"set {key} back, use another out=, or delete that folder"
            )
        before = {"steps": stored["step"], "seconds": stored["seconds"], "device": ""}  # of a time that kept none
        self.sittings = stored.get("sittings", [before])
        return last, stored


def sittings_of(checkpoints: Path, training: str) -> list[dict[str, Any]]:
    """What each process added to a training (`steps`, `seconds`, `device`), as its newest checkpoint says; empty where
    there is none. `training` is put before them.
    """
    newest = max(checkpoints.glob("step_*/state.json"), default=None)
    found = [] if newest is None else read_json(newest).get("sittings", [])
    return [{"training": training, **sitting} for sitting in found]


def optimizer_tensors(optimizer: torch.optim.Optimizer, names: Sequence[str] = ()) -> dict[str, Tensor]:
    """State as `PARAMETER/STATE` tensors, and `groupI/step` of groups that count their steps themselves. Parameters
    that never had a gradient have none. They have numbers where `names`, in the optimiser's order, is empty.
    """
    stored = optimizer.state_dict()
    tensors = {
        f"{names[index] if names else index}/{key}": torch.as_tensor(value)
        for index, values in stored["state"].items()
        for key, value in values.items()
    }
    counted = {f"group{index}/step": group["step"] for index, group in enumerate(stored["param_groups"])
               if "step" in group}  # fmt: skip
    return tensors | {key: torch.tensor(value) for key, value in counted.items()}


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], where: str, names: Sequence[str] = ()
) -> None:
    """Put `optimizer_tensors` back; settings such as the learning rate stay those of `optimizer`. A CheckpointError
    where a tensor is unexpected, missing, or of another shape.
    """
    groups = optimizer.state_dict()["param_groups"]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    index = {name: i for i, name in enumerate(names or map(str, range(len(parameters))))}
    state: dict[int, dict[str, Tensor]] = {}
    counters = {f"group{i}/step": group for i, group in enumerate(groups) if "step" in group}
    for key, value in tensors.items():
        owner, _, what = key.rpartition("/")
        if key in counters:
            counters[key]["step"] = int(value)
            continue
        if owner not in index:
            raise CheckpointError(f"{where} holds the unexpected tensor {key}: use another out= or delete it")
        shape = () if what == "step" else tuple(parameters[index[owner]].shape)
        if tuple(value.shape) != shape:
            raise CheckpointError(
                f"{where}: {key} has shape {tuple(value.shape)}, expected {shape}: delete that folder"
            )
        state.setdefault(index[owner], {})[what] = value
    expected = sorted({what for values in state.values() for what in values})
    for owner, i in index.items():
        if i in state and len(state[i]) < len(expected):
            raise CheckpointError(f"{where} misses a tensor of {owner}, expected {', '.join(expected)}: delete it")
    optimizer.load_state_dict({"state": state, "param_groups": groups})
