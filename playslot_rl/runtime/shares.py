"""Shares of a global batch: each forward pass computes one of equal, consecutive slices of it.

    rows of share i of n:   B i/n  to  B (i+1)/n

Everything random is drawn for the whole batch and then sliced, and every property of the batch (codes, BatchNorm,
information) is computed from all of it: so the result does not depend on the number of shares. Outside of `sharing`
there is one share, and all functions here give back what they were given.

Shapes: B rows of the global batch, n shares, b = B / n rows of one, W processes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor, nn

from playslot_rl.runtime import processes

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class Share:
    """One slice of the global batch: i of n, which is processes times the micro-batches of each, those of one process
    consecutive; `micro` of the process's `micros`. Of a `rehearsal` no step is made: it shows what the first batch is
    like.
    """

    index: int = 0
    count: int = 1
    micro: int = 0
    micros: int = 1
    rehearsal: bool = False


_WHOLE = Share()
_share: ContextVar[Share] = ContextVar("share", default=_WHOLE)


def share() -> Share:
    """The slice that is being computed."""
    return _share.get()


@contextlib.contextmanager
def sharing(of: Share) -> Iterator[None]:
    """Inside the block forward passes compute this slice."""
    token = _share.set(of)
    try:
        yield
    finally:
        _share.reset(token)


def own_rows[Rows: (Tensor, npt.NDArray[np.int64])](rows: Rows) -> Rows:
    """The own slice (b, ...) of what belongs to the global batch (B, ...), which the shares have to divide."""
    own = _share.get()
    if own.count == 1:
        return rows
    if len(rows) % own.count:
        raise ValueError(f"batch: got {len(rows)} rows, expected a multiple of {own.count} shares")
    size = len(rows) // own.count
    return rows[own.index * size : (own.index + 1) * size]


def own_noise(shape: tuple[int, ...] | torch.Size, draw: Callable[[tuple[int, ...]], Tensor]) -> Tensor:
    """Random numbers of the own rows, of the shape (b, ...): `draw` is called with the global batch's."""
    own = _share.get()
    return own_rows(drawn(lambda: draw((shape[0] * own.count, *shape[1:]))))


def drawn(draw: Callable[[], Tensor]) -> Tensor:
    """What `draw` gives: all that a step draws at random while it computes. Inside of `taped` the tape hands it out."""
    tape = _tape.get()
    return draw() if tape is None else tape.take(draw)


class Tape(Protocol):
    """Hands out random numbers that can be drawn anew, in the same order."""

    def take(self, draw: Callable[[], Tensor]) -> Tensor:
        """What `draw` gives, or gave."""


_tape: ContextVar[Tape | None] = ContextVar("tape", default=None)


@contextlib.contextmanager
def taped(tape: Tape) -> Iterator[None]:
    """Inside the block `drawn` takes from this tape."""
    token = _tape.set(tape)
    try:
        yield
    finally:
        _tape.reset(token)


def all_rows(own: Tensor) -> Tensor:
    """Rows (b, ...) of this process with those of all others that compute at the same time, rank by rank: (W b, ...).

    Differentiable: the gradient of a row is the sum of those that all processes have for it.
    """
    if _share.get() is _WHOLE or processes.here().world == 1:
        return own
    rows: Tensor = _AllRows.apply(own)  # type: ignore[no-untyped-call]
    return rows


def averaged(value: Tensor) -> Tensor:
    """Mean over the processes that compute at the same time; no gradient."""
    if _share.get() is _WHOLE or processes.here().world == 1:
        return value
    return processes.summed(value.detach().clone()) / processes.here().world


class _AllRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, own: Tensor) -> Tensor:  # noqa: ARG004
        return processes.stacked(own)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:  # noqa: ARG004
        whole = processes.summed(grads[0].clone(memory_format=torch.contiguous_format))
        here = processes.here()
        size = len(whole) // here.world
        return whole[here.rank * size : (here.rank + 1) * size]


class GlobalBatchNorm(nn.modules.batchnorm._BatchNorm):
    """BatchNorm by the statistics of the global batch, on any device: torch's `SyncBatchNorm` needs a GPU.

        mean = 1/W sum_r mean_r,   var = 1/W sum_r [var_r + (mean_r - mean)^2]

    where every process has equally many values. In evaluation mode, and outside of `sharing`, it is torch's own.
    """

    @classmethod
    def of(cls, norm: nn.modules.batchnorm._BatchNorm) -> GlobalBatchNorm:
        """The same layer, with the same parameters and buffers."""
        made = cls.__new__(cls)
        made.__dict__ = norm.__dict__
        return made

    def forward(self, x: Tensor) -> Tensor:
        """(b, C, ...) to the same shape."""
        if not self.training or _share.get() is _WHOLE or processes.here().world == 1:
            return super().forward(x)
        values = x.float() if x.element_size() < 4 else x
        var, mean = torch.var_mean(values, [i for i in range(x.ndim) if i != 1], unbiased=False)
        means, variances = all_rows(torch.stack((mean, var))[None]).unbind(1)
        mean = means.mean(0)
        var = variances.mean(0) + (means - mean).square().mean(0)
        self._remember(mean.detach(), var.detach(), processes.here().world * values.numel() // len(mean))
        scale = (var + self.eps).rsqrt()
        if self.weight is not None:
            scale = scale * self.weight
        along = [1, -1, *[1] * (x.ndim - 2)]
        out = (values - mean.view(along)) * scale.view(along)
        if self.bias is not None:
            out = out + self.bias.view(along)
        return out.to(x.dtype)

    @torch.no_grad()
    def _remember(self, mean: Tensor, var: Tensor, count: int) -> None:
        if self.running_mean is None or self.running_var is None:
            return
        if self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
        momentum = self.momentum
        if momentum is None:
            momentum = 1.0 / float(self.num_batches_tracked)  # type: ignore[arg-type]
        self.running_mean.lerp_(mean, momentum)
        self.running_var.lerp_(var * (count / max(1, count - 1)), momentum)

    def _check_input_dim(self, x: Tensor) -> None:
        """Any number of dimensions."""


def global_norms(module: nn.Module) -> None:
    """Have all BatchNorm layers below a module use the global batch's statistics; weights and their names stay."""
    for name, child in module.named_children():
        if isinstance(child, nn.modules.batchnorm._BatchNorm) and not isinstance(child, GlobalBatchNorm):
            setattr(module, name, GlobalBatchNorm.of(child))
        else:
            global_norms(child)
