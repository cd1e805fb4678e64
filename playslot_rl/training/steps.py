"""One optimisation step: as it is written, or captured once as a CUDA graph and replayed.

    batch, random numbers -> buffers;   [ loss, gradients, clipping, Adam ] -> numbers

What is in brackets is one graph for each phase of a stage (`playslot_rl.training.stage.PhasedStage`), of all shares of
the batch that a process computes and with what it exchanges with others; a replay costs the host one launch instead of
thousands. Random numbers are drawn before it, by the same generators in the same order as without a graph, so that they
stay a function of seed, step and stream.

Nothing in a step on a GPU waits for it: a step whose loss or gradient is not finite is skipped by Adam and found at the
next look (`Steps.not_finite`).
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import torch
from torch import Tensor

from playslot_rl.config import StageConfig
from playslot_rl.errors import ConfigError, TrainingError
from playslot_rl.runtime.captured import recorded, stopped_at
from playslot_rl.runtime.processes import agreed, here, recordable
from playslot_rl.runtime.shares import Share, sharing, taped
from playslot_rl.seeds.draws import StepGenerators, derived_seed, global_seed
from playslot_rl.training.batches import GlobalBatches
from playslot_rl.training.memory import does_not_fit, out_of_memory
from playslot_rl.training.optimizer import clip_gradients
from playslot_rl.training.stage import PhasedStage, SeparateStage

WARM: Final = 3
"""Steps of a phase that are taken as they are written: kernels are chosen and Adam's state is made in them."""


class _Tape:
    """The rows of a share of the batch, and the random numbers of its step, in buffers: recorded in one step, handed
    out while the next is captured, drawn anew before each replay.
    """

    def __init__(self, share: Share, seed: int) -> None:
        self.share, self.seed, self.step = share, seed, 0
        self.inputs: dict[str, Tensor] = {}
        self._generators: dict[tuple[str, str], torch.Generator] = {}
        self._buffers: list[Tensor] = []
        self._events: list[Callable[[], object]] = []
        self._served: int | None = None

    def begin(self, anew: bool) -> None:
        """From now on what is drawn is remembered, in place of all before; or the buffers are handed out in order."""
        if anew:
            self.inputs, self._buffers, self._events = {}, [], []
        self._served = None if anew else 0

    def fill(self, batch: Mapping[str, Tensor]) -> None:
        """Put these rows and the numbers of `step` into the buffers."""
        for name, value in batch.items():
            if name in self.inputs:
                self.inputs[name].copy_(value)
            else:
                self.inputs[name] = value.clone()
        for event in self._events:
            event()

    def take(self, draw: Callable[[], Tensor]) -> Tensor:
        if self._served is not None:
            self._served += 1
            return self._buffers[self._served - 1]
        buffer = draw().clone()
        self._buffers.append(buffer)
        self._events.append(lambda: buffer.copy_(draw()))
        return buffer

    def generator(self, stream: str, device: torch.device | str) -> torch.Generator:
        """That of a stream, which lives on from step to step and is seeded for each."""
        key = (stream, str(device))
        if key not in self._generators:  # none may be made while a step is captured
            self._generators[key] = torch.Generator(device=device)
        generator = self._generators[key]

        def seeded() -> torch.Generator:
            return generator.manual_seed(derived_seed(self.seed, self.step, stream))

        if self._served is None:
            seeded()
            self._events.append(seeded)
        return generator


@dataclass(frozen=True)
class _TapedGenerators(StepGenerators):
    tape: _Tape = field(kw_only=True)

    def torch(self, stream: str, device: torch.device | str | None = None) -> torch.Generator:
        return self.tape.generator(stream, self.device if device is None else device)


class Steps:
    """Takes the steps of one training.

    Args:
        name: of the training, and `key` its dotted config group, for messages.

    Raises:
        ConfigError: `execution=graph` without a GPU, or with what a graph cannot hold.
    """

    def __init__(
        self,
        name: str,
        key: str,
        batches: GlobalBatches,
        optimizer: torch.optim.Optimizer,
        config: StageConfig,
        seed: int,
        device: torch.device | str,
    ) -> None:
        self.name, self.key, self.batches, self.stage = name, key, batches, batches.stage
        self.optimizer, self.config, self.seed, self.device = optimizer, config, seed, torch.device(device)
        self.on_gpu = self.device.type == "cuda"
        self._separate = isinstance(self.stage, SeparateStage) and self.stage.separate
        self.captures = self._captures()
        self._tapes = [_Tape(share, seed) for share in batches.shares]
        self._replay: Callable[[], None] | None = None
        self._phase: Hashable = None
        self._taken = 0
        self._said = False
        self._values: dict[str, Tensor] = {}
        self._trouble = torch.full((3,), -1.0, device=self.device)
        self._number = torch.zeros((), device=self.device)
        self._stream = torch.cuda.Stream(self.device) if self.on_gpu else None

    def take(self, step: int, rate: float) -> dict[str, Tensor]:
        """Step `step` (from 0) at a learning rate: its losses and `grad_norm`, scalars on the device, without gradient.

        Raises:
            TrainingError: the batch does not fit into the GPU's memory.
        """
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        try:
            with self._streamed():
                self._number.fill_(step)
                return self._captured(step) if self.captures else self._written(step)
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
        # The error is gone, and with it its frames and what they held.
        self.release()
        self.optimizer.zero_grad(set_to_none=True)
        raise does_not_fit(self.batches, self.config, self.key, step, self.seed, self.device)

    def not_finite(self) -> tuple[str, float, int] | None:
        """What was not finite first since the training began, its value, and after how many steps; this waits."""
        step, loss, norm = self._trouble.tolist()
        if step < 0:
            return None
        what, value = ("gradient norm", norm) if math.isfinite(loss) else ("loss", loss)
        return what, value, int(step) + 1

    def release(self) -> None:
        """Let go of what was recorded, and its memory: NCCL's processes cannot part while a graph exchanges by them."""
        self._replay, self._values, self._taken = None, {}, 0
        for tape in self._tapes:
            tape.begin(anew=True)

    def _written(self, step: int) -> dict[str, Tensor]:
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.batches.backward(step, StepGenerators(self.seed, step, self.device))
        return self._stepped(losses)

    def _stepped(self, losses: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Clip, look whether all is finite, and let Adam step where it is."""
        norm = clip_gradients(self.batches.parameters, self.config.optim.grad_clip, separate=self._separate)
        found = torch.stack([self._number, losses["loss"].detach().float(), norm.detach().float()])
        bad = ~found.isfinite().all()
        self._trouble.copy_(torch.where(bad & (self._trouble[0] < 0), found, self._trouble))
        if self.on_gpu:
            self.optimizer.found_inf = bad.to(torch.float32)  # type: ignore[attr-defined]  # Adam skips the step where it is 1
            self.optimizer.step()
        elif not bad:
            self.optimizer.step()
        return {**{key: value.detach() for key, value in losses.items()}, "grad_norm": norm.detach()}

    def _captured(self, step: int) -> dict[str, Tensor]:
        phase = self.stage.phase(step) if isinstance(self.stage, PhasedStage) else "all"
        if phase is None:
            self._refused("these steps compute something else each time, or wait for values")
            return self._written(step)
        if phase != self._phase:
            self.release()
            self._phase = phase
        if self.batches.begins:
            return self._written(step)
        if self._taken < WARM:
            self._taken += 1
            return self._computed(step, warm=True)
        *others, last = self._tapes
        for tape in others:
            with self._seeded(tape, step):
                tape.fill(self._batch(step))
        with self._seeded(last, step):
            last.fill(self._batch(step))
            if self._replay is None:
                self._replay = self._recorded(partial(self._computed, step))
            if self._replay is not None:
                self._replay()
                return self._values
        return self._written(step)

    def _computed(self, step: int, warm: bool = False) -> dict[str, Tensor]:
        """The step from the buffers, or the one by which they are made (`warm`)."""
        self.optimizer.zero_grad(set_to_none=True)
        numbers = []
        for tape in self._tapes:
            generators = _TapedGenerators(self.seed, step, self.device, tape=tape)
            tape.begin(anew=warm)
            with self._seeded(tape, step) if warm else sharing(tape.share):
                batch = self._batch(step) if warm else tape.inputs
                with taped(tape):
                    numbers.append(self.batches.gradients(batch, step, generators))
        return self._stepped(self.batches.combined(numbers))

    def _batch(self, step: int) -> Mapping[str, Tensor]:
        return self.stage.batch(step, StepGenerators(self.seed, step, self.device))

    @contextlib.contextmanager
    def _seeded(self, tape: _Tape, step: int) -> Iterator[None]:
        """As a share is computed in `GlobalBatches.backward`: each draws the numbers of the whole batch."""
        tape.step = step
        with global_seed(self.seed, step), sharing(tape.share):
            yield

    def _recorded(self, compute: Callable[[], dict[str, Tensor]]) -> Callable[[], None] | None:
        """What computes the same once more, into the same `_values`; None where it cannot be captured, which is said.
        Either all processes get one, or none: a replay waits for those of the others.

        Raises:
            TrainingError: it cannot, and `execution` is `graph`.
        """
        assert self._stream is not None
        try:
            replay, self._values = recorded(compute, self._stream)
        except RuntimeError as error:
            agreed(False)
            if out_of_memory(error):
                raise
            self._refused(f"a step could not be captured at {stopped_at(error)}", error)
        else:
            if all(agreed(True)):
                return replay
            self._refused("another process could not capture a step, and says why")
        self.captures = False
        self.release()
        return None

    def _refused(self, why: str, error: RuntimeError | None = None) -> None:
        """Say once why steps are not captured; an error where `execution` is `graph`."""
        if self.config.execution == "graph":
            raise TrainingError(f"{self.name}: {why}: use {self.key}.execution=auto") from error
        if not self._said:
            self._said = True
            warnings.warn(f"{self.name}: {why}; their kernels are launched one by one", RuntimeWarning, stacklevel=3)

    def _captures(self) -> bool:
        """Whether steps are to be captured, by the setting and by what there is."""
        wanted, why, several = self.config.execution, "", here().world > 1
        if not self.on_gpu:
            why = f"got device {self.device.type}, expected cuda"
        elif several and not recordable():
            why = "got processes that do not meet by NCCL, whose exchanges alone can be captured"
        elif several and wanted == "auto":
            why = f"got {here().world} processes, for which a step is captured by {self.key}.execution=graph alone"
        if wanted == "graph" and why:
            raise ConfigError(f"{self.key}.execution=graph: {why}: use {self.key}.execution=auto")
        if wanted == "auto" and why and self.on_gpu and here().first:
            warnings.warn(f"{self.name}: {why}: its kernels are launched one by one", RuntimeWarning, stacklevel=2)
        return wanted != "eager" and not why

    @contextlib.contextmanager
    def _streamed(self) -> Iterator[None]:
        """All steps run on one stream of their own, as a capture has to, between what else runs."""
        if self._stream is None:
            yield
            return
        self._stream.wait_stream(torch.cuda.current_stream(self.device))
        try:
            with torch.cuda.stream(self._stream):
                yield
        finally:
            torch.cuda.current_stream(self.device).wait_stream(self._stream)
