"""What every training loop does beside learning: where its numbers go, and one line for what goes wrong.

Numbers go to `metrics.jsonl` always, and to TensorBoard, Weights & Biases or trackio by a setting.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import threading
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import nn

from playslot_rl.config import LoggingConfig
from playslot_rl.errors import ConfigError, TrainingError
from playslot_rl.storage.atomic import explain_write_errors, write_text
from playslot_rl.storage.resume import TrainingCheckpoints
from playslot_rl.storage.tensors import module_tensors


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
        """Add one line. Raises OutputError: full disk."""
        with explain_write_errors(self.path), self.path.open("a") as file:
            file.write(json.dumps({"step": step, "split": split, **values}) + "\n")


class _TensorBoardLogger:
    def __init__(self, folder: Path, resumed: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # Its thread prints an error that is raised here, too, at the next entry.
        self._hook, threading.excepthook = threading.excepthook, self._unless_written
        try:
            self._writer: Any = SummaryWriter(str(folder), purge_step=resumed + 1 if resumed else None)
        except BaseException:
            threading.excepthook = self._hook
            raise

    def log(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def show(self, pictures: Mapping[str, npt.NDArray[np.uint8]], step: int) -> None:
        for name, picture in pictures.items():
            self._writer.add_image(name, picture, step, dataformats="HWC")

    def close(self) -> None:
        try:
            self._writer.flush()  # raises what the thread ran into
            self._writer.close()
        finally:
            threading.excepthook = self._hook

    def _unless_written(self, args: threading.ExceptHookArgs) -> None:
        if not (issubclass(args.exc_type, OSError) and "_AsyncWriter" in type(args.thread).__name__):
            self._hook(args)


class _RunLogger:
    """Weights & Biases and trackio, which share `init`, `log` and `finish`."""

    def __init__(self, module: Any, settings: dict[str, Any]) -> None:
        self._module = module
        module.init(**settings)

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._module.log(dict(values), step=step)

    def show(self, pictures: Mapping[str, npt.NDArray[np.uint8]], step: int) -> None:
        self._module.log({name: self._module.Image(picture) for name, picture in pictures.items()}, step=step)

    def close(self) -> None:
        self._module.finish()


def open_logger(config: LoggingConfig, folder: Path, resumed: int) -> _TensorBoardLogger | _RunLogger | None:
    """Open a backend in a training's `logs`; None where there is none. Entries that a killed run wrote after the step
    it carries on from, `resumed`, are hidden.

    Raises:
        ConfigError: the backend's package is not installed.
    """
    if config.backend == "none":
        return None
    folder.mkdir(parents=True, exist_ok=True)
    if config.backend == "tensorboard":
        return _TensorBoardLogger(folder, resumed)
    try:
        module = importlib.import_module(config.backend)
    except ImportError as error:
        raise ConfigError(
            f"logging.backend={config.backend}: the package {config.backend} is not installed; install it by "
            f"`pip install 'playslot_rl[{config.backend}]'`, or use logging.backend=tensorboard"
        ) from error
    own = folder / "run_id"  # kept: a folder that is moved goes on, and one of the same name elsewhere is another
    if not own.is_file():
        write_text(own, uuid.uuid4().hex[:8])
    run_id = own.read_text()
    name = "-".join([*folder.resolve().parts[-4:-1], run_id])  # RUN and its stage, of which a part may have a folder
    settings: dict[str, Any] = {"project": config.project, "name": name, "resume": "allow"}
    if config.backend == "wandb":
        settings |= {"dir": str(folder), "id": run_id, "mode": os.environ.get("WANDB_MODE", "online")}
    return _RunLogger(module, settings)


def finite(values: Mapping[str, float]) -> dict[str, float]:
    """JSON has no NaN; a number that could not be computed is left out, never invented."""
    return {key: value for key, value in values.items() if math.isfinite(value)}


class Watch:
    """The numbers and the errors of one training; its folder gets `metrics.jsonl` and `logs/`, and `cure` is what to
    try where a number is not finite.
    """

    def __init__(self, name: str, folder: Path, checkpoints: TrainingCheckpoints, cure: str) -> None:
        self.name, self.folder, self.checkpoints, self.cure = name, folder, checkpoints, cure
        self.history = History(folder / "metrics.jsonl")
        self._logger: _TensorBoardLogger | _RunLogger | None = None
        self._warned: frozenset[str] = frozenset()

    @property
    def shows_pictures(self) -> bool:
        return self._logger is not None

    def warn(self, step: int, warnings: Mapping[str, str]) -> None:
        """Print warnings, by kind, to standard output: each when it comes up, and again once it had gone away."""
        for kind, text in warnings.items():
            if kind not in self._warned:
                print(f"{self.name}: warning at step {step}: {text}", flush=True)
        self._warned = frozenset(warnings)

    def show(self, step: int, pictures: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        """Hand pictures (H, W, 3), by name, to the backend."""
        if self._logger is not None:
            self._logger.show({f"{self.name}/validation/{name}": picture for name, picture in pictures.items()}, step)

    @contextlib.contextmanager
    def running(self, logging: LoggingConfig, start: int) -> Iterator[None]:
        """Log to the backend, too, inside the block; a KeyboardInterrupt in it says where the same command carries on.
        A ConfigError where the backend's package is not installed.
        """
        self._logger = open_logger(logging, self.folder / "logs", start)
        try:
            yield
        except KeyboardInterrupt:
            last = self.checkpoints.last()
            where = f"step {int(last.name.removeprefix('step_'))} ({last})" if last else "the beginning"
            raise KeyboardInterrupt(f"{self.name} interrupted; the same command carries on from {where}") from None
        finally:
            if self._logger is not None:
                self._logger.close()

    def log(self, split: str, step: int, values: Mapping[str, float], *, at: int | None) -> None:
        """Record the numbers that are finite: in `metrics.jsonl` by `step`, in the backend by the step `at` unless it
        is None; the split is `train`, `validation` or `acting`. An OutputError where the disk is full.
        """
        kept = finite(values)
        self.history.append(split, step, kept)
        if self._logger is not None and at is not None:
            # Numbers that say when a line was written, the backends know.
            named = {
                f"{self.name}/{split}/{key}": value for key, value in kept.items() if key not in ("seconds", "updates")
            }
            self._logger.log(named, at)

    def require_finite(self, modules: Mapping[str, nn.Module], when: str) -> None:
        """A finite loss may still have made an infinite weight or buffer: never keep that as a good checkpoint. The
        TrainingError names the tensor.
        """
        for key, value in module_tensors(modules).items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise self.not_finite(key, "not finite", when)

    def not_finite(self, what: str, got: str, when: str) -> TrainingError:
        last = self.checkpoints.last()
        kept = f"the last good checkpoint is {last}" if last else "there is no checkpoint yet"
        return TrainingError(
            f"{self.name}: {what} is {got} at {when}, expected a finite number; {kept}; {self.cure}, "
            "and use another out="
        )
