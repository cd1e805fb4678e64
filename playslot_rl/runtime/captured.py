"""A function of tensors that is called again and again, on a GPU as one launch instead of hundreds."""

from __future__ import annotations

import contextlib
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

SHAPES: Final = 8
"""Graphs that are kept, of the shapes used last."""
_capturing: ContextVar[bool] = ContextVar("capturing", default=True)
Key = tuple[object, ...]


@contextlib.contextmanager
def uncaptured() -> Iterator[None]:
    """Inside the block every `Captured` calls its function as it is; what it recorded stays."""
    before = _capturing.set(False)
    try:
        yield
    finally:
        _capturing.reset(before)


class Captured[Result]:
    """Calls a function; on a GPU without gradients a second call with the same shapes records it as a CUDA graph, and
    later ones replay that.

    Args:
        function: computes from its arguments and a module's weights alone, without waiting for the device and without
            random numbers.
        module: whose weights are read. Where they lie elsewhere than before, as after `.to`, all is recorded anew.

    Warns:
        RuntimeWarning: it could not be recorded; it is called as it is from then on.
    """

    def __init__(self, function: Callable[..., Result], module: nn.Module) -> None:
        self.function, self.module = function, module
        self._graphs: OrderedDict[Key, Callable[..., Result] | None] = OrderedDict()
        self._captures = True

    def __call__(self, *inputs: Tensor) -> Result:
        capturing = self._captures and _capturing.get()
        if not capturing or inputs[0].device.type != "cuda" or torch.is_grad_enabled():
            return self.function(*inputs)
        weights = next(self.module.parameters()).data_ptr()
        key: Key = (weights, *((value.shape, value.dtype, value.device) for value in inputs))
        known = key in self._graphs
        replay = self._graphs.pop(key, None)
        if known and replay is None:
            replay = self._recorded(inputs)
        self._graphs[key] = replay
        while len(self._graphs) > SHAPES:
            self._graphs.popitem(last=False)
        return self.function(*inputs) if replay is None else replay(*inputs)

    def _recorded(self, inputs: tuple[Tensor, ...]) -> Callable[..., Result] | None:
        graph, buffers = torch.cuda.CUDAGraph(), [value.clone() for value in inputs]
        try:
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                result = self.function(*buffers)
        except RuntimeError as error:
            first = str(error).splitlines()[0]
            warnings.warn(f"a CUDA graph could not be recorded: {first}", RuntimeWarning, stacklevel=3)
            self._captures = False
            return None

        def replay(*given: Tensor) -> Result:
            for buffer, value in zip(buffers, given, strict=True):
                buffer.copy_(value)
            graph.replay()
            copied: Result = pytree.tree_map(lambda value: value.clone(), result)
            return copied

        return replay

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies record their own."""
        return (type(self), (self.function, self.module))
