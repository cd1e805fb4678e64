"""One job of a study: a training and how it is measured.

A job is a file, `OUT/jobs/NAME.json`, that says everything; `python -m playslot_rl.recipes.compare_job FILE` runs it,
on any machine that sees the folder, and running it again carries on or does nothing.
"""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from playslot_rl.config.compose import is_pretrained
from playslot_rl.config.weights import data_roots, is_remote
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing


class Job(ABC):
    """What a job of any study has.

    Attributes:
        method: what is trained.
        seed: of the training.
        out: folder of the study.
        wave: jobs of a lower wave end before a launcher starts those of a higher one.
    """

    method: str
    seed: int
    out: Path

    @property
    @abstractmethod
    def name(self) -> str:
        """Of its folder, and a word to Hydra, which `=` would end."""

    @property
    @abstractmethod
    def title(self) -> str:
        """As tables and plots name it."""

    @property
    @abstractmethod
    def stage(self) -> str:
        """Stage of the run whose checkpoint is the method's."""

    @property
    def wave(self) -> int:
        return 0

    @property
    def file(self) -> Path:
        """What it is told."""
        return self.out / "jobs" / f"{self.name}.json"

    @property
    def run(self) -> Path:
        """The run folder it writes."""
        return self.out / "runs" / self.name


def fingerprint_of(content: Any) -> str:
    """Short name of plain values, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def absolute(path: str) -> str:
    """A path from the root; nothing, shipped models (`pretrained/ENV`) and addresses on the Hub as they are."""
    return path if not path or is_pretrained(path) or is_remote(path) else str(Path(path).expanduser().resolve())


def absolute_roots(text: str) -> str:
    """`data.root` with every folder from the root; weights stay."""
    return ",".join(root._replace(path=absolute(root.path)).text for root in data_roots(text))


def count_parameters(run: Run, stage: str) -> int:
    """Floating-point numbers in a run's checkpoint and in those of its parents (weights, and a few buffers)."""
    from safetensors import safe_open

    folders = [run.place(stage)]
    for name in json_or_nothing(run.place(stage) / "meta.json").get("parents", {}):
        folders.append(run.place(name) if run.place(name).is_dir() else run.world_run.place(name))
    count = 0
    for folder in folders:
        with safe_open(folder / "weights.safetensors", framework="pt") as file:
            slices = [file.get_slice(key) for key in file.keys()]  # noqa: SIM118  no mapping
            count += sum(math.prod(part.get_shape()) for part in slices if part.get_dtype().startswith(("F", "BF")))
    return count
