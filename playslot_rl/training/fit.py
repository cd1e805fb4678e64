"""The one training loop of all stages.

A stage says what it trains and what its loss is; the loop steps Adam, schedules, clips, checks, logs, validates and
checkpoints. Killed at any moment and started again, it ends with the same weights and buffers, bit for bit on a CPU.
Of several processes (`playslot_rl.runtime.processes`) each computes its share of every batch, and the first one writes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from playslot_rl.config import LoggingConfig, OptimConfig, StageConfig
from playslot_rl.config.roles import without
from playslot_rl.errors import CheckpointError
from playslot_rl.runtime.precision import keeping, resolve_precision
from playslot_rl.runtime.processes import agreed, here, spreading, wait
from playslot_rl.runtime.progress import StageProgress
from playslot_rl.seeds.draws import global_seed
from playslot_rl.storage.resume import TrainingCheckpoints, TrainingState
from playslot_rl.training.averages import WeightAverage
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.compiling import compile_parts, compiling_pays, release_parts, worth_compiling
from playslot_rl.training.logging import Watch, finite
from playslot_rl.training.optimizer import build_adam, learning_rate, trainable_parameters
from playslot_rl.training.pace import Pace
from playslot_rl.training.patience import Patience
from playslot_rl.training.stage import Stage, WatchedStage
from playslot_rl.training.steps import Steps


@dataclass(frozen=True)
class Part:
    """One training of a stage.

    Attributes:
        name: for messages, logs and the checkpoints' identity (`slots`, `decoder`).
        stage: modules, already on their device, with their loss.
        config: steps, optimiser, intervals.
        folder: below the stage's own; empty is that one.
        group: dotted name of its config, for messages; `NAME` if empty.
        renamed: of that config the keys that are typed by another full name.
        identity: further plain values that a resumed one must share.
        patience: ends the training before `config.steps`, with the weights of the best validation; None does not.
        pace: changes `config.steps` as the clock says; None does not.
        optimizer: makes Adam, or one of its kind, of the parameters.
    """

    name: str
    stage: Stage
    config: StageConfig
    folder: str = ""
    group: str = ""
    renamed: Mapping[str, str] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    patience: Patience | None = None
    pace: Pace | None = None
    optimizer: Callable[[Mapping[str, nn.Parameter], OptimConfig], torch.optim.Adam] = build_adam

    def typed(self, key: str) -> str:
        """The full name under which a key of `config` is typed."""
        return self.renamed.get(key, f"{self.group or self.name}.{key}")


def fit(
    part: Part,
    folder: Path,
    *,
    seed: int,
    device: torch.device | str = "cpu",
    logging: LoggingConfig | None = None,
    identity: Mapping[str, Any] | None = None,
    typed: Callable[[str], str] = str,
    ready: Callable[[], None] | None = None,
) -> tuple[TrainingState, int]:
    """Train to `part.config.steps` or the end of patience, carrying on from the newest checkpoint if there is one.

    Writes `checkpoints/step_*`, `logs/` and `metrics.jsonl` in the part's folder, nothing else; with several processes,
    all of which call this, the first one does.

    Args:
        part: what is trained.
        folder: the stage's folder.
        seed: all randomness derives from it and from the step.
        device: device of the generators.
        logging: backend and progress bar; None logs to `metrics.jsonl` only, silently.
        identity: further plain values a resumed run must share (model config, data and parent fingerprints).
        typed: from a key of these to the full name under which it is typed.
        ready: called once, before the first step, when a stage begun before was found to be the same.

    Returns:
        Where it ended, and the step this process started at: the same if there was nothing left to do.

    Raises:
        ConfigError: the processes do not divide the batch.
        TrainingError: a loss or gradient is not finite; the last good checkpoint stays.
        CheckpointError: the folder was begun with another config, or its checkpoint is damaged.
        OutputError: full disk; the last good checkpoint stays.
        KeyboardInterrupt: Ctrl-C; its message says where the same command carries on.
    """
    silent = LoggingConfig(backend="none", progress=False)
    logging, config = (logging or silent) if here().first else silent, part.config
    run = _Run(part, folder / part.folder, seed, device, identity or {}, typed)
    start = run.state.step
    if here().first:
        if ready is not None:
            ready()
        run.watch.history.rewind(start)
    wait()  # until all have looked, and what is there is there for all
    run.meet()
    if not run.ended:
        progress = StageProgress(part.name, start, run.planned, logging.progress, config.log_every * 10)
        with run.watch.running(logging, start), keeping(run.state.precision), run.compiled(), progress:
            while not run.ended:
                run.advance(run.state.step, progress)
    if run.average is not None:
        run.average.settle()
    if run.steps.on_gpu:
        run.steps.release()
        run.optimizer.zero_grad(set_to_none=True)  # gradients of a captured step hold all of its memory
    return run.state, start


def own_checkpoints(
    part: Part, folder: Path, seed: int, identity: Mapping[str, Any], typed: Callable[[str], str]
) -> TrainingCheckpoints:
    """What a part in that folder carries on from; the rest as of `fit`."""
    own = {part.name: without(part.config, "free"), "seed": seed}
    if part.patience is not None:  # when it looks decides where it ends
        own["validate_every"] = part.config.validate_every
    begins = f"{part.name}."
    return TrainingCheckpoints(
        folder / "checkpoints",
        {**own, **identity, **part.identity},
        lambda key: part.typed(key.removeprefix(begins)) if key.startswith(begins) else typed(key),
    )


class _Run:
    """One process's part of a stage: the pieces `fit` moves from step to step."""

    def __init__(
        self,
        part: Part,
        folder: Path,
        seed: int,
        device: torch.device | str,
        identity: Mapping[str, Any],
        typed: Callable[[str], str],
    ) -> None:
        self.part, self.stage, self.config, self.seed, self.device = part, part.stage, part.config, seed, device
        self.folder, self.patience = folder, part.patience
        self.parameters = trainable_parameters(part.stage.modules)
        self.batches = GlobalBatches(part.stage, part.config, self.parameters, part.group or part.name)
        self.optimizer = part.optimizer(self.parameters, part.config.optim)
        self.steps = Steps(part.name, part.group or part.name, self.batches, self.optimizer, part.config, seed, device)
        ema = part.config.optim.ema
        self.average = WeightAverage(self.parameters, ema) if ema else None
        self.checkpoints = own_checkpoints(part, folder, seed, identity, typed)
        cure = f"lower {part.typed('optim.lr')} or check the data"
        self.watch = Watch(part.name, folder, self.checkpoints, cure)
        self.state = self.checkpoints.resume(part.stage.modules, self.optimizer, self.parameters, self._averaged)
        self._began = time.monotonic() - self.state.seconds
        self._looked, self._validation, self._validating = (self.state.step, self.state.seconds), 0.0, 0.0
        self._train_mode(True)

    @property
    def planned(self) -> int:
        """Of the whole training, as it is planned now."""
        return self.state.planned or self.config.steps

    @property
    def ended(self) -> bool:
        patient = self.patience is None or not self.patience.ended(self.state)
        return self.state.step >= self.planned or not patient

    @property
    def _averaged(self) -> Mapping[str, Tensor] | None:
        return None if self.average is None else self.average.tensors

    def meet(self) -> None:
        """Begin together: at the same step, in one precision, with the first process's weights and buffers.

        Raises:
            CheckpointError: processes have found checkpoints of different steps.
        """
        steps = agreed(self.state.step)
        if len(set(steps)) > 1:
            raise CheckpointError(
                f"{self.folder}: got checkpoints of steps {', '.join(map(str, steps))} on ranks 0 to {len(steps) - 1}, "
                "expected one: out= has to be a folder that all machines share"
            )
        if self.ended:
            return
        self.batches.meet()
        with keeping(self.state.precision):
            own = resolve_precision(self.config.precision, torch.device(self.device).type)
        self.state = replace(self.state, precision="bf16" if agreed(own == "bf16")[0] else "fp32")

    @contextlib.contextmanager
    def compiled(self) -> Iterator[None]:
        """Inside the block the networks' parts are compiled, if the config says so, or leaves it open and it pays."""
        asked = self.config.compile
        unasked = asked is None and compiling_pays(torch.device(self.device), self.planned - self.state.step)
        if not (asked or unasked):
            yield
            return
        modules = {**self.stage.modules, **getattr(self.stage, "frozen", {})}
        if unasked:
            modules = worth_compiling(modules)
        compile_parts(modules, self.part.typed("compile"))
        try:
            yield
        finally:
            release_parts(modules)

    def advance(self, step: int, progress: StageProgress) -> None:
        """One step, and whatever is due after it."""
        config, done = self.config, step + 1
        values = self._step(step)
        intervals = (config.log_every, config.validate_every, config.checkpoint_every)
        looks = done in (1, self.planned) or any(done % every == 0 for every in intervals)
        if looks or not self.steps.on_gpu:  # it waits for a GPU: before the clock is read and anything is kept
            self._require_finite()
        self.state = replace(self.state, step=done, seconds=time.monotonic() - self._began)
        self._keep_pace()
        last, progress.total = done == self.planned, self.planned
        if done == 1 or done % config.log_every == 0 or last:
            numbers = {key: float(value) for key, value in values.items()}
            self._log("train", done, numbers)
            progress.update(done, numbers)
        else:
            progress.update(done, {})
        if done % config.validate_every == 0 or last:
            began = time.monotonic()
            self.state = replace(self.state, metrics=self._validate(done))
            self._validation = time.monotonic() - began
            self._validating += self._validation
            self._log("validation", done, self.state.metrics)
            self._look(done)
            self._judge()
        if done % config.checkpoint_every == 0 or self.ended:
            self.watch.require_finite(self.stage.modules, f"step {done}")
            if here().first:
                self.checkpoints.save(self.state, self.stage.modules, self.optimizer, self.parameters, self._averaged)

    def _keep_pace(self) -> None:
        """Plan anew if it is time to: from the steps since the last look, and what came between them."""
        pace, (done, spent), state = self.part.pace, self._looked, self.state
        if pace is None or not pace.due(state.step - done, state.seconds - spent, self.planned):
            return
        if self.steps.on_gpu:
            self._require_finite()
            self.state = state = replace(state, seconds=time.monotonic() - self._began)
        # Validations come now and then, but evenly over all steps.
        a_step = (state.seconds - spent - self._validating) / (state.step - done)
        a_step += self._validation / self.config.validate_every
        planned = pace.steps(state.step, state.seconds, a_step, self.planned, self._validation)
        if planned != self.planned:  # stays told where a later look takes it back: the rate went another way meanwhile
            self.state = replace(state, planned=planned)
        self._looked, self._validating = (state.step, state.seconds), 0.0

    def _step(self, step: int) -> dict[str, Tensor | float]:
        rate = learning_rate(self.config.optim, step, self.planned)
        values = self.steps.take(step, rate)
        if self.average is not None:
            self.average.update(step + 1)
        return {**values, "lr": rate}

    def _require_finite(self) -> None:
        found = self.steps.not_finite()
        if found is not None:
            what, value, step = found
            raise self.watch.not_finite(what, str(value), f"step {step}")

    def _validate(self, done: int) -> dict[str, float]:
        self._train_mode(False)
        with self._shown(), spreading(), torch.no_grad(), global_seed(self.seed, done, "validation"):
            values = {key: float(value) for key, value in self.stage.validate(done).items()}
        self._train_mode(True)
        kept = finite(values)
        watched = values.keys() if self.patience is None else {self.patience.watched}
        if values and not watched & kept.keys():
            raise self.watch.not_finite("validation", next(iter(watched)) + " not finite", f"step {done}")
        return kept

    def _look(self, done: int) -> None:
        if not isinstance(self.stage, WatchedStage):
            return
        self.watch.warn(done, self.stage.warnings(done, self.state.metrics))
        if not self.watch.shows_pictures:
            return
        self._train_mode(False)
        with self._shown(), torch.no_grad(), global_seed(self.seed, done, "validation"):
            pictures = self.stage.pictures(done)
        self._train_mode(True)
        self.watch.show(done, pictures)

    def _judge(self) -> None:
        if self.patience is None:
            return
        modules = self.stage.modules
        self.watch.require_finite(modules, f"step {self.state.step}")
        with self._shown():
            self.state = self.patience.judge(self.state, modules, self.folder)
        if self.ended:
            self.state = self.patience.restore(self.state, modules, self.folder)
            if self.average is not None:
                self.average.restart()

    def _shown(self) -> contextlib.AbstractContextManager[None]:
        """The weights that count: their average, if there is one."""
        return contextlib.nullcontext() if self.average is None else self.average.shown()

    def _train_mode(self, on: bool) -> None:
        for module in self.stage.modules.values():
            module.train(on)

    def _log(self, split: str, step: int, values: Mapping[str, float]) -> None:
        if not here().first:
            return
        self.watch.log(split, step, {**values, "seconds": round(self.state.seconds, 3)}, at=step)
