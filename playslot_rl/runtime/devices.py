"""The device that computes, by the name that people type."""

from __future__ import annotations

import functools
import platform
from pathlib import Path
from typing import TYPE_CHECKING, Final

from playslot_rl.errors import ConfigError, first_line, require_type

if TYPE_CHECKING:
    import torch
    from torch import Tensor

KINDS: Final = ("cpu", "cuda", "mps", "xpu")
"""Kinds of devices on which numbers are computed; torch knows others, such as `meta`, which only keep shapes."""


def named_device(name: str | torch.device = "") -> torch.device:
    """The device of a name such as `cuda:1`, which need not be there (`probed`); empty means a GPU if there is one. A
    TypeError for no text, a ConfigError for no such kind of device, or one that computes nothing.

    Examples:
        >>> named_device("cuda:1").index
        1
    """
    import torch

    require_type(name, "device", str, torch.device, expected="its name, such as 'cpu' or 'cuda'")
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
    except RuntimeError as error:
        raise ConfigError(f"device={name}: {first_line(error)}; use device=cpu") from error
    if device.type not in KINDS:
        raise ConfigError(
            f"device={name}: got a device that computes nothing, expected one of {', '.join(KINDS)}; use device=cpu"
        )
    return device


@functools.cache
def processor() -> str:
    """The kind of processor that computes here, and of GPU where there is one: `AMD EPYC 9R14, NVIDIA H100`."""
    import torch

    about = Path("/proc/cpuinfo")
    lines = about.read_text(errors="replace").splitlines() if about.is_file() else []
    named = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    kinds = [named or platform.processor() or platform.machine()]
    return ", ".join([*kinds, torch.cuda.get_device_name()] if torch.cuda.is_available() else kinds)


def device_name(device: torch.device) -> str:
    """What computes there: a GPU's name, or the processor's."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else processor().partition(", ")[0]


def to_device(values: Tensor, device: torch.device) -> Tensor:
    """The values on a device; the host does not wait for the copy to a GPU."""
    if device.type == "cuda" and values.device.type == "cpu":
        return values.pin_memory().to(device, non_blocking=True)
    return values.to(device)


def open_device(name: str, threads: int) -> torch.device:
    """The device of a name (`named_device`) that computes, after setting threads and the allocator; of several
    processes on GPUs each has its own. A ConfigError where there is none.
    """
    from playslot_rl.runtime.processes import own_device
    from playslot_rl.runtime.threads import set_threads, tune_allocator

    tune_allocator()
    set_threads(threads)
    return probed(own_device(named_device(name)))


def probed(device: torch.device) -> torch.device:
    """The device, after a look whether it is there, else a ConfigError."""
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device={device}: {first_line(error)}; use device=cpu") from error
    return device
