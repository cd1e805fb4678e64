"""Which arithmetic a training's convolutions and transformers use, and the context that surrounds them.

`bf16` pays only where the processor multiplies it itself (AVX-512 BF16 or AMX, any GPU since NVIDIA's Ampere).
Elsewhere every product is emulated: SAVi's step at `compact` takes 6 s instead of 0.6 s on an EPYC that has AVX2
alone. `auto` is `bf16` where it pays (`bf16_pays`), and what a training began with where that goes on (`keeping`).
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from time import perf_counter
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    import torch

Precision = Literal["fp32", "bf16", "auto"]

PAYS: Final = 1.1
"""So many times quicker bf16 has to be on a GPU."""
_ARITHMETIC: Final = ("avx512_bf16", "amx_bf16", "bf16", "arm_bf16")


@functools.cache
def native_bf16(device_type: str) -> bool:
    """Whether devices of a type (`cpu`, `cuda`) multiply bfloat16 in hardware."""
    import torch

    if device_type == "cpu":
        has = torch.cpu.get_capabilities()
        return any(has.get(name, False) for name in _ARITHMETIC)
    return device_type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def bf16_pays(device_type: str) -> bool:
    """Whether bf16 is the quicker one on devices of a type.

    On a GPU that has it this is measured, once a process. A processor is taken at its word: emulated bf16 is ten times
    slower and native bf16 clearly quicker, while what is measured on busy cores could come out either way, and a seeded
    run repeats bit for bit.
    """
    if device_type != "cuda" or not native_bf16(device_type):
        return native_bf16(device_type)
    return speedup(device_type) >= PAYS


@functools.cache
def speedup(device_type: str, frames: int = 64, side: int = 64, repeats: int = 5) -> float:
    """How many times quicker than fp32 a convolution of 64 channels, forward and backward, is in bf16: the quickest of
    some, taken in turn, some milliseconds in all. Draws no random numbers.
    """
    import torch

    with torch.inference_mode(False), torch.enable_grad():
        images = torch.ones(frames, 64, side, side, device=device_type, requires_grad=True)
        weight = torch.ones(64, 64, 5, 5, device=device_type, requires_grad=True)

        def took(bf16: bool) -> float:
            began = perf_counter()
            with torch.autocast(device_type, torch.bfloat16, enabled=bf16, cache_enabled=False):
                out = torch.nn.functional.conv2d(images, weight, padding=2)
            torch.autograd.grad(out.sum(), (images, weight))
            if device_type == "cuda":
                torch.cuda.synchronize()
            return perf_counter() - began

        turns = [(took(False), took(True)) for _ in range(repeats + 1)][1:]  # kernels are chosen in the first
    return min(fp32 for fp32, _ in turns) / min(bf16 for _, bf16 in turns)


_kept: ContextVar[str] = ContextVar("kept", default="auto")


@contextlib.contextmanager
def keeping(precision: str) -> Iterator[None]:
    """Inside the block `auto` stands for this, but for `bf16` where that is emulated: there a training that began
    elsewhere goes on in fp32, ten times quicker.
    """
    token = _kept.set(precision)
    try:
        yield
    finally:
        _kept.reset(token)


def resolve_precision(precision: Precision, device_type: str) -> Precision:
    """`auto` as what it stands for on a device of this type; `fp32` and `bf16` as they are."""
    if precision != "auto":
        return precision
    kept = _kept.get()
    pays = bf16_pays(device_type) if kept == "auto" else kept == "bf16" and native_bf16(device_type)
    return "bf16" if pays else "fp32"


def in_bf16(device_type: str, precision: Precision) -> bool:
    """Whether a stage of a precision computes in bf16; a RuntimeWarning says where that is emulated."""
    if precision == "bf16" and not native_bf16(device_type):
        _warn_of_emulation(device_type)
    return resolve_precision(precision, device_type) == "bf16"


def autocast(device_type: str, precision: Precision) -> torch.autocast:
    """Surrounds what a stage computes in its precision; warns as `in_bf16`."""
    import torch

    return torch.autocast(device_type, torch.bfloat16, enabled=in_bf16(device_type, precision))


def full_precision(device_type: str) -> torch.autocast:
    """Inside an `autocast`, surrounds what small differences pass through: it is computed in its inputs' precision."""
    import torch

    return torch.autocast(device_type, enabled=False)


@functools.cache
def _warn_of_emulation(device_type: str) -> None:
    warnings.warn(
        f"precision: got bf16, which this {device_type} only emulates, many times slower than fp32: use precision=auto",
        RuntimeWarning,
        stacklevel=3,
    )
