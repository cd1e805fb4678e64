"""What every training loop does beside learning: numbers to files, and one line for what goes wrong."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from torch import nn

from playslot_rl.config import LoggingConfig
from playslot_rl.errors import TrainingError
from playslot_rl.storage.resume import TrainingCheckpoints
from playslot_rl.storage.tensors import module_tensors
from playslot_rl.training.logging import History, MetricLogger, open_logger


def finite(values: Mapping[str, float]) -> dict[str, float]:
    """JSON has no NaN; a number that could not be computed is left out, never invented."""
    return {key: value for key, value in values.items() if math.isfinite(value)}


class Watch:
    """The numbers and the errors of one training.

    Args:
        name: the training, for messages and logs.
        folder: gets `metrics.jsonl` and `logs/`.
        checkpoints: of the training.
        cure: what to try where a number is not finite.
    """

    def __init__(self, name: str, folder: Path, checkpoints: TrainingCheckpoints, cure: str) -> None:
        self.name, self.folder, self.checkpoints, self.cure = name, folder, checkpoints, cure
        self.history = History(folder / "metrics.jsonl")
        self._logger: MetricLogger | None = None

    @contextlib.contextmanager
    def running(self, logging: LoggingConfig, start: int) -> Iterator[None]:
        """Log to the backend, too, inside the block; an interrupt in it says where the same command carries on.

        Raises:
            KeyboardInterrupt: Ctrl-C, with that message.
            ConfigError: the backend's package is not installed.
        """
        self._logger = open_logger(logging, self.folder / "logs", self.name, start)
        try:
            yield
        except KeyboardInterrupt:
            last = self.checkpoints.last()
            where = f"step {int(last.name.removeprefix('step_'))} ({last})" if last else "the beginning"
            raise KeyboardInterrupt(f"{self.name} interrupted; the same command carries on from {where}") from None
        finally:
            self._logger.close()

    def log(self, split: str, step: int, values: Mapping[str, float], *, at: int | None) -> None:
        """Record numbers.

        Args:
            split: `train`, `validation` or `acting`.
            step: of `metrics.jsonl`.
            values: their names and values; those that are not finite are left out.
            at: step of the backend; None leaves it out.

        Raises:
            OutputError: full disk.
        """
        kept = finite(values)
        self.history.append(split, step, kept)
        if self._logger is not None and at is not None:
            named = {f"{self.name}/{split}/{key}": value for key, value in kept.items() if key not in _OF_THE_FILE}
            self._logger.log(named, at)

    def require_finite(self, modules: Mapping[str, nn.Module], when: str) -> None:
        """A finite loss may still have made an infinite weight or buffer: never keep that as a good checkpoint.

        Raises:
            TrainingError: names the tensor.
        """
        for key, value in module_tensors(modules).items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise self.not_finite(key, "not finite", when)

    def not_finite(self, what: str, got: str, when: str) -> TrainingError:
        """The error of a number that is not finite."""
        last = self.checkpoints.last()
        kept = f"the last good checkpoint is {last}" if last else "there is no checkpoint yet"
        return TrainingError(
            f"{self.name}: {what} is {got} at {when}, expected a finite number; {kept}; {self.cure}, "
            "and use another out="
        )


_OF_THE_FILE = frozenset({"seconds", "updates"})
"""Numbers of a line that say when it was written: the backends know it."""
