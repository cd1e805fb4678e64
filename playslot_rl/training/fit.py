"""The one training loop of all stages.

A stage says what it trains and what its loss is; the loop steps Adam, schedules, clips, checks, logs, validates and
checkpoints. Killed at any moment and started again, it ends with the same weights and buffers, bit for bit on a CPU.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from playslot_rl.config import LoggingConfig, StageConfig
from playslot_rl.config.roles import fixed_keys
from playslot_rl.errors import TrainingError
from playslot_rl.progress import StageProgress
from playslot_rl.seeding import StepGenerators, global_seed
from playslot_rl.storage.resume import TrainingCheckpoints, TrainingState
from playslot_rl.storage.tensors import module_tensors
from playslot_rl.training.logging import History, MetricLogger, open_logger
from playslot_rl.training.optim import build_adam, clip_gradients, learning_rate, trainable_parameters


class Stage(Protocol):
    """What a stage gives to `fit`. It keeps no state of its own between steps, except in its modules."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """What is trained and stored, by name; parameters without `requires_grad` are stored, not trained."""

    def loss(self, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        """Scalars of one step; `loss` is minimised, the others are logged. All randomness comes from `generators`."""

    def validate(self, step: int) -> Mapping[str, float]:
        """Numbers on held-out data after `step` steps; called without gradients, modules in eval mode."""


@dataclass(frozen=True)
class FitResult:
    """What `fit` did.

    Attributes:
        step: finished steps.
        resumed_from: step this process started at; equal to `step` if there was nothing left to do.
        seconds: wall-clock seconds of all steps, over all processes.
        metrics: the last validation.
    """

    step: int
    resumed_from: int
    seconds: float
    metrics: dict[str, float]


def fit(
    stage: Stage,
    config: StageConfig,
    folder: Path,
    *,
    name: str,
    seed: int,
    device: torch.device | str = "cpu",
    logging: LoggingConfig | None = None,
    identity: Mapping[str, Any] | None = None,
    ready: Callable[[], None] | None = None,
    rate: str = "",
) -> FitResult:
    """Train a stage to `config.steps`, carrying on from its newest checkpoint if it has one.

    Writes `folder/checkpoints/step_*`, `folder/logs/` and `folder/metrics.jsonl`, nothing else.

    Args:
        stage: modules, already on `device`, with their loss.
        config: steps, optimiser, intervals.
        folder: the stage's folder.
        name: the stage, for messages and for the prefix of config keys (`slots`, `dynamics`, `behaviour`).
        seed: all randomness derives from it and from the step.
        device: device of the generators.
        logging: backend and progress bar; None logs to `metrics.jsonl` only, silently.
        identity: further plain values a resumed run must share (model config, data and parent fingerprints).
        ready: called once, before the first step, when a stage begun before was found to be the same.
        rate: config key of the learning rate, for messages; empty means `NAME.optim.lr`.

    Raises:
        TrainingError: a loss or gradient is not finite; the last good checkpoint stays.
        CheckpointError: the folder was begun with another config, or its checkpoint is damaged.
        OutputError: full disk; the last good checkpoint stays.
        KeyboardInterrupt: Ctrl-C; its message says where the same command carries on.
    """
    logging = logging or LoggingConfig(backend="none", progress=False)
    run = _Run(stage, config, folder, name, seed, device, identity or {}, rate or f"{name}.optim.lr")
    if ready is not None:
        ready()
    start = run.state.step
    run.history.rewind(start)
    if start >= config.steps:
        return FitResult(start, start, run.state.seconds, run.state.metrics)
    logger = open_logger(logging, folder / "logs", name, start)
    progress = StageProgress(name, start, config.steps, logging.progress, config.log_every * 10)
    try:
        with progress:
            for step in range(start, config.steps):
                run.advance(step, logger, progress)
    except KeyboardInterrupt:
        last = run.checkpoints.last()
        where = f"step {int(last.name.removeprefix('step_'))} ({last})" if last else "the beginning"
        raise KeyboardInterrupt(f"{name} interrupted; the same command carries on from {where}") from None
    finally:
        logger.close()
    return FitResult(run.state.step, start, run.state.seconds, run.state.metrics)


class _Run:
    """One process's part of a stage: the pieces `fit` moves from step to step."""

    def __init__(
        self,
        stage: Stage,
        config: StageConfig,
        folder: Path,
        name: str,
        seed: int,
        device: torch.device | str,
        identity: Mapping[str, Any],
        rate: str,
    ) -> None:
        self.rate = rate
        self.stage, self.config, self.name, self.seed, self.device = stage, config, name, seed, device
        self.parameters = trainable_parameters(stage.modules)
        self.optimizer = build_adam(self.parameters, config.optim)
        self.checkpoints = TrainingCheckpoints(
            folder / "checkpoints", {name: fixed_keys(config), "seed": seed, **identity}
        )
        self.history = History(folder / "metrics.jsonl")
        self.state = self.checkpoints.resume(stage.modules, self.optimizer, self.parameters)
        self._began = time.monotonic() - self.state.seconds
        self._train_mode(True)

    def advance(self, step: int, logger: MetricLogger, progress: StageProgress) -> None:
        """One step, and whatever is due after it."""
        config, done = self.config, step + 1
        values = self._step(step)
        last = done == config.steps
        self.state = TrainingState(done, time.monotonic() - self._began, self.state.metrics)
        if done == 1 or done % config.log_every == 0 or last:
            numbers = {key: float(value) for key, value in values.items()}
            self._log("train", done, numbers, logger)
            progress.update(done, numbers)
        else:
            progress.update(done, {})
        if done % config.validate_every == 0 or last:
            self.state = replace(self.state, metrics=self._validate(done))
            self._log("validation", done, self.state.metrics, logger)
        if done % config.checkpoint_every == 0 or last:
            self._require_finite(done)
            self.checkpoints.save(self.state, self.stage.modules, self.optimizer, self.parameters)

    def _step(self, step: int) -> dict[str, Tensor | float]:
        rate = learning_rate(self.config.optim, step, self.config.steps)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        with global_seed(self.seed, step):
            losses = self.stage.loss(step, StepGenerators(self.seed, step, self.device))
            losses["loss"].backward()
        norm = clip_gradients(self.parameters, self.config.optim.grad_clip)
        # One transfer for both, so that a GPU is waited for once a step.
        loss, size = torch.stack([losses["loss"].detach().float(), norm.float()]).tolist()
        if not (math.isfinite(loss) and math.isfinite(size)):
            raise self._diverged(step, loss, size)
        self.optimizer.step()
        values: dict[str, Tensor | float] = {key: value.detach() for key, value in losses.items()}
        return values | {"loss": loss, "lr": rate, "grad_norm": size}

    def _require_finite(self, done: int) -> None:
        """A finite loss may still have made an infinite weight or buffer: never keep that as a good checkpoint."""
        for key, value in module_tensors(self.stage.modules).items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise self._not_finite(done - 1, key, "not finite")

    def _diverged(self, step: int, loss: float, norm: float) -> TrainingError:
        what, got = ("loss", loss) if not math.isfinite(loss) else ("gradient norm", norm)
        return self._not_finite(step, what, str(got))

    def _not_finite(self, step: int, what: str, got: str) -> TrainingError:
        last = self.checkpoints.last()
        kept = f"the last good checkpoint is {last}" if last else "there is no checkpoint yet"
        return TrainingError(
            f"{self.name}: {what} is {got} at step {step + 1}, expected a finite number; {kept}; "
            f"lower {self.rate} or check the data, and use another out="
        )

    def _validate(self, done: int) -> dict[str, float]:
        self._train_mode(False)
        with torch.no_grad(), global_seed(self.seed, done, "validation"):
            values = {key: float(value) for key, value in self.stage.validate(done).items()}
        self._train_mode(True)
        # JSON has no NaN; a number that could not be computed is left out, never invented.
        finite = {key: value for key, value in values.items() if math.isfinite(value)}
        if values and not finite:
            raise self._not_finite(done - 1, "validation", next(iter(values)) + " not finite")
        return finite

    def _train_mode(self, on: bool) -> None:
        for module in self.stage.modules.values():
            module.train(on)

    def _log(self, split: str, step: int, values: dict[str, float], logger: MetricLogger) -> None:
        # JSON has no NaN; a number that could not be computed is left out, never invented.
        finite = {key: value for key, value in values.items() if math.isfinite(value)}
        self.history.append(split, step, finite | {"seconds": round(self.state.seconds, 3)})
        logger.log({f"{self.name}/{split}/{key}": value for key, value in finite.items()}, step)


def as_dict(result: FitResult) -> dict[str, Any]:
    """A result as plain values, for a checkpoint's meta file."""
    return asdict(result)
