"""A batch that does not fit into a GPU's memory, and one that does: smaller and smaller parts of it are tried, each by
its loss and gradients, until what they take at most is `SAFE` of what is free.

Not by a straight line through two small ones: convolutions take what memory there is to be quick.
"""

from __future__ import annotations

import contextlib
import gc
import math
from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

from playslot_rl.config import StageConfig
from playslot_rl.errors import TrainingError
from playslot_rl.runtime.processes import here
from playslot_rl.runtime.shares import Share, sharing
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.batches import GlobalBatches

SAFE: Final = 0.9
"""Of what is free: the rest is for the optimiser's first step, and for gaps between tensors."""
SHARES: Final = (7 / 8, 3 / 4, 5 / 8, 1 / 2, 3 / 8, 1 / 4, 3 / 16, 1 / 8, 1 / 16, 1 / 32)
"""Of the batch, in the order in which they are tried."""
PARTS: Final = (1, 2, 4, 8)
"""Into so many the batch is cut where it cannot even be made."""
ROWS: Final = 8
"""A batch is a multiple of so many rows."""


def out_of_memory(error: BaseException) -> bool:
    """Whether an error, or what it came from (a capture that ended early), is a GPU without memory."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, torch.OutOfMemoryError):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


def does_not_fit(
    batches: GlobalBatches, config: StageConfig, key: str, step: int, seed: int, device: torch.device
) -> TrainingError:
    """The error of a step that ran out of memory and holds none any more; `key` is the dotted group of `config`."""
    share = config.batch_size // batches.count
    try:
        free = free_memory(device)
        trial = _Trial(batches, step, seed, device)
        rows = fitting(trial.peak, trial.rows, free, trial.rows < share)
    except (RuntimeError, ValueError, AssertionError):  # not even these fit, or the device is in no state to tell
        rows = 0
    largest = rows * batches.count
    unit = math.lcm(ROWS, batches.count)
    largest -= largest % (unit if largest >= unit else batches.count)
    what = f"{key}.batch_size: got {config.batch_size}, which does not fit into {device_memory(device)}"
    if largest == 0:
        return TrainingError(f"{what}, expected one that does; a small one does not either: choose smaller sizes")
    cure = f"{what}, expected at most {largest}: use it"
    if not batches.by_batch:
        cure += f", or {key}.optim.accumulate={_micros(config, rows)}"
    return TrainingError(cure)


def fitting(peak: Callable[[int], float], rows: int, free: float, whole: bool = False) -> int:
    """The largest of `SHARES` of some rows, or all of them where the `whole` may fit, whose peak is within what is
    free, in rows; 0 if none is.
    """
    for share in (1.0, *SHARES) if whole else SHARES:
        some = int(rows * share)
        with contextlib.suppress(torch.OutOfMemoryError):
            if some and peak(some) <= SAFE * free:
                return some
    return 0


def free_memory(device: torch.device) -> float:
    """Bytes that tensors can still take on a GPU."""
    gc.collect()
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + cached


def peak_memory(compute: Callable[[], None], device: torch.device) -> float:
    """Bytes that tensors take on a GPU at most while something is computed, beside those there are."""
    gc.collect()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    compute()
    return torch.cuda.max_memory_allocated(device) - before


def device_memory(device: torch.device) -> str:
    """A GPU and its memory, in words."""
    if device.type != "cuda":
        return f"the memory of {device}"
    total = torch.cuda.get_device_properties(device).total_memory
    return f"the {total / 2**30:.0f} GiB of {torch.cuda.get_device_name(device)}"


class _Trial:
    """Loss and gradients of the first rows of a step's batch, by this process alone; the batch waits on the CPU."""

    def __init__(self, batches: GlobalBatches, step: int, seed: int, device: torch.device) -> None:
        self.batches, self.step, self.seed, self.device = batches, step, seed, device
        self.generators = StepGenerators(seed, step, device)
        self.batch: dict[str, Tensor] = {}
        for parts in PARTS:  # to make the batch may be what takes too much
            own = Share(here().rank * batches.micros * parts, batches.count * parts, 0, batches.micros)
            with contextlib.suppress(torch.OutOfMemoryError), global_seed(seed, step), sharing(own):
                self.batch = {k: v.cpu() for k, v in batches.stage.batch(step, self.generators).items()}
            if self.batch:
                break
        self.rows = max(map(len, self.batch.values()))
        self.held = sum(value.nbytes for value in self.batch.values()) * parts * batches.micros

    def peak(self, rows: int) -> float:
        """Bytes, with those of the process's whole batch, whose micro-batches a captured step holds together."""
        parts = {key: value[: max(1, len(value) * rows // self.rows)] for key, value in self.batch.items()}

        def compute() -> None:
            batch = {key: value.to(self.device) for key, value in parts.items()}
            with global_seed(self.seed, self.step):
                self.batches.stage.loss(batch, self.step, self.generators)["loss"].backward()

        try:
            return peak_memory(compute, self.device) + self.held
        finally:
            for parameter in self.batches.parameters.values():
                parameter.grad = None


def _micros(config: StageConfig, rows: int) -> int:
    """The fewest micro-batches that divide a process's batch into shares of at most so many rows."""
    own = config.batch_size // here().world
    return next(n for n in range(1, own + 1) if own % n == 0 and own // n <= rows)
