"""Which arithmetic a training's convolutions and transformers use, and the context that surrounds them.

`bf16` pays only where the processor multiplies it itself (AVX-512 BF16 or AMX, any GPU since NVIDIA's Ampere).
Elsewhere every product is emulated: SAVi's step at `compact` takes 6 s instead of 0.6 s on an EPYC that has AVX2
alone. `auto` is `bf16` on the former and `fp32` on the latter.
"""

from __future__ import annotations

import functools
import warnings
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    import torch

Precision = Literal["fp32", "bf16", "auto"]

_ARITHMETIC: Final = ("avx512_bf16", "amx_bf16", "bf16", "arm_bf16")


@functools.cache
def native_bf16(device_type: str) -> bool:
    """Whether devices of a type (`cpu`, `cuda`) multiply bfloat16 in hardware."""
    import torch

    if device_type == "cpu":
        has = torch.cpu.get_capabilities()
        return any(has.get(name, False) for name in _ARITHMETIC)
    return device_type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def resolve_precision(precision: Precision, device_type: str) -> Precision:
    """`auto` as what it stands for on a device of this type; `fp32` and `bf16` as they are."""
    if precision != "auto":
        return precision
    return "bf16" if native_bf16(device_type) else "fp32"


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
