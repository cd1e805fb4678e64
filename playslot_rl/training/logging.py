"""Where a stage's numbers go: `metrics.jsonl` always, and TensorBoard, Weights & Biases or trackio by a setting."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from playslot_rl.config import LoggingConfig
from playslot_rl.errors import ConfigError
from playslot_rl.storage.atomic import explain_write_errors, write_text


class MetricLogger(Protocol):
    """A logging backend."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Record named numbers at a step."""

    def close(self) -> None:
        """Flush and release."""


class History:
    """`metrics.jsonl`: one JSON object a line, `{"step": ..., "split": "train" | "validation", NAME: number}`.

    `rewind` drops what a killed run wrote after its last checkpoint, so that a resumed run writes each line once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[dict[str, Any]]:
        """All whole lines; a line cut off by a kill is left out."""
        rows: list[dict[str, Any]] = []
        for line in self.path.read_text().splitlines() if self.path.exists() else []:
            try:
                rows.append(json.loads(line))
            except json.JSONDecodeError:
                break
        return rows

    def rewind(self, step: int) -> None:
        """Keep the lines up to and including `step`."""
        kept = [row for row in self.read() if row["step"] <= step]
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in kept))

    def append(self, split: str, step: int, values: Mapping[str, float]) -> None:
        """Add one line.

        Raises:
            OutputError: full disk.
        """
        with explain_write_errors(self.path), self.path.open("a") as file:
            file.write(json.dumps({"step": step, "split": split, **values}) + "\n")


class _NoLogger:
    def log(self, values: Mapping[str, float], step: int) -> None:
        pass

    def close(self) -> None:
        pass


class _TensorBoardLogger:
    def __init__(self, folder: Path, resumed: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder), purge_step=resumed + 1 if resumed else None)

    def log(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class _RunLogger:
    """Weights & Biases and trackio, which share `init`, `log` and `finish`."""

    def __init__(self, module: Any, settings: dict[str, Any]) -> None:
        self._module = module
        module.init(**settings)

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._module.log(dict(values), step=step)

    def close(self) -> None:
        self._module.finish()


def _optional(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"logging.backend={name}: the package {name} is not installed; install it by "
            f"`pip install 'playslot_rl[{name}]'`, or use logging.backend=tensorboard"
        ) from error


def open_logger(config: LoggingConfig, folder: Path, name: str, resumed: int = 0) -> MetricLogger:
    """Open a backend.

    Args:
        config: the backend and its project.
        folder: where it writes.
        name: the stage, part of the run's name.
        resumed: step a run carries on from; later entries of a killed run are hidden.

    Raises:
        ConfigError: the backend's package is not installed.
    """
    if config.backend == "none":
        return _NoLogger()
    folder.mkdir(parents=True, exist_ok=True)
    if config.backend == "tensorboard":
        return _TensorBoardLogger(folder, resumed)
    module = _optional(config.backend)
    run_name = f"{folder.resolve().parent.parent.name}-{name}"
    settings: dict[str, Any] = {"project": config.project, "name": run_name, "resume": "allow"}
    if config.backend == "wandb":
        settings |= {"dir": str(folder), "id": run_name, "mode": os.environ.get("WANDB_MODE", "online")}
    return _RunLogger(module, settings)
