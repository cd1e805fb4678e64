"""What no step of a training or a search may do, since a GPU would wait for it and a graph cannot have it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = ("_local_scalar_dense", "lift_fresh", "nonzero", "bincount", "masked_select", "unique")
"""Operators that need a value on the host, a shape that depends on values, or a tensor made of a list (an index)."""


class _Seen(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.waits: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        by_mask = "index" in func.name() and any(
            isinstance(index, Tensor) and index.dtype == torch.bool
            for given in args[1:2]
            for index in (given if isinstance(given, list | tuple) else [given])
        )
        if by_mask or any(wait in func.name() for wait in WAITS):
            self.waits.add(func.name())
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def no_waits() -> Iterator[None]:
    """Inside the block no tensor's value may be read."""

    def refuse(tensor: Tensor, *_: Any) -> None:
        raise AssertionError(f"a value of {tuple(tensor.shape)} was read")

    seen = _Seen()  # type: ignore[no-untyped-call]
    with pytest.MonkeyPatch.context() as patch:
        for method in ("item", "tolist", "cpu", "numpy", "__bool__", "__float__", "__int__"):
            patch.setattr(Tensor, method, refuse)
        with seen:
            yield
    assert seen.waits == set()
