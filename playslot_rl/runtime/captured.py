"""A function of tensors that is called again and again, on a GPU as one launch instead of hundreds."""

from __future__ import annotations

import contextlib
import gc
import inspect
import itertools
import traceback
import warnings
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from playslot_rl.errors import first_line

SHAPES: Final = 8
"""Graphs that are kept, of the shapes used last."""
PACKAGE: Final = str(Path(__file__).parents[1])
_failed: Final[list[torch.cuda.CUDAGraph]] = []
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


def recorded[Result](compute: Callable[[], Result], stream: torch.cuda.Stream) -> tuple[Callable[[], None], Result]:
    """Record what a function computes on a stream, which is not run by that: what runs it, and what it will have
    computed, always in the same place. Raises the error of torch where it cannot be recorded (`stopped_at`).
    """
    graph = torch.cuda.CUDAGraph()
    try:
        return graph.replay, _captured(graph, compute, stream)
    except BaseException:
        # The random generator is left as in a capture, so that draws and replays of other graphs fail: the end of a
        # capture that succeeds sets it right. The allocator keeps pointing at the graph.
        _failed.append(graph)
        with contextlib.suppress(RuntimeError):
            _captured(torch.cuda.CUDAGraph(), lambda: torch.zeros(1, device=stream.device), stream)
        raise


def _captured[Result](graph: torch.cuda.CUDAGraph, compute: Callable[[], Result], stream: torch.cuda.Stream) -> Result:
    collects = gc.isenabled()
    # The outer stream is there to be put back: a capture that fails does not.
    with (
        torch.cuda.device(stream.device),
        torch.cuda.stream(stream),
        torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
    ):
        gc.disable()  # it could destroy an older graph, which a capture may not see
        try:
            return compute()
        finally:
            if collects:
                gc.enable()


def stopped_at(error: BaseException) -> str:
    """The line that a recording stopped at, and why: of the error that came first, since its end raises one, too."""
    while error.__context__ is not None:
        error = error.__context__
    where = traceback.extract_tb(error.__traceback__)
    own = [at for at in where if at.filename.startswith(PACKAGE)] or where
    return f"`{own[-1].line if own else '?'}`: {first_line(error)}"


class Captured[Result]:
    """Calls a function; on a GPU without gradients a second call with the same shapes records it as a CUDA graph, and
    later ones replay that.

    Args:
        function: computes from its arguments and a module's weights alone, without waiting for the device and without
            random numbers. A method is held weakly, so that its object may hold this.
        module: whose weights are read. Where they lie elsewhere than before, as after `.to`, or are in another mode or
            precision, all is recorded anew. Held weakly.

    Warns:
        RuntimeWarning: it could not be recorded; it is called as it is from then on.
    """

    def __init__(self, function: Callable[..., Result], module: nn.Module) -> None:
        self._function: Any = weakref.WeakMethod(function) if inspect.ismethod(function) else lambda: function
        self._module = weakref.ref(module)
        self._graphs: OrderedDict[Key, Callable[..., Result] | None] = OrderedDict()
        self._captures = True
        self._stream: torch.cuda.Stream | None = None

    @property
    def function(self) -> Callable[..., Result]:
        """What is called."""
        found: Callable[..., Result] = self._function()
        return found

    def __call__(self, *inputs: Tensor) -> Result:
        capturing = self._captures and _capturing.get()
        if not capturing or inputs[0].device.type != "cuda" or torch.is_grad_enabled():
            return self.function(*inputs)
        key = self._key(inputs)
        known = key in self._graphs
        replay = self._graphs.pop(key, None)
        if known and replay is None:
            replay = self._recorded(inputs)
        self._graphs[key] = replay
        while len(self._graphs) > SHAPES:
            self._graphs.popitem(last=False)
        return self.function(*inputs) if replay is None else replay(*inputs)

    def _key(self, inputs: tuple[Tensor, ...]) -> Key:
        module = self._module()
        assert module is not None
        weights = (part.data_ptr() for part in itertools.chain(module.parameters(), module.buffers()))
        mode = (module.training, getattr(module, "precision", None), torch.is_autocast_enabled("cuda"))
        return (*weights, *mode, *((value.shape, value.dtype, value.device) for value in inputs))

    def _recorded(self, inputs: tuple[Tensor, ...]) -> Callable[..., Result] | None:
        device = inputs[0].device
        buffers = [value.clone() for value in inputs]
        self._stream = self._stream or torch.cuda.Stream(device)
        self._stream.wait_stream(torch.cuda.current_stream(device))
        try:
            again, result = recorded(lambda: self.function(*buffers), self._stream)
        except RuntimeError as error:
            reason = f"a CUDA graph could not be recorded at {stopped_at(error)}"
            warnings.warn(reason, RuntimeWarning, stacklevel=3)
            self._captures = False
            return None
        torch.cuda.current_stream(device).wait_stream(self._stream)

        def replay(*given: Tensor) -> Result:
            for buffer, value in zip(buffers, given, strict=True):
                buffer.copy_(value)
            again()
            copied: Result = pytree.tree_map(lambda value: value.clone(), result)
            return copied

        return replay

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies record their own."""
        return (type(self), (self.function, self._module()))
