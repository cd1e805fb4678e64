"""Torch's threads, the cores and the allocator of this process."""

from __future__ import annotations

import ctypes
import os
import platform
from typing import Final

# Names and numbers of glibc's malloc.h: M_MMAP_MAX, M_TRIM_THRESHOLD, M_TOP_PAD.
_MALLOC: Final = ((-4, 0), (-1, 2**31 - 1), (-2, 256 * 2**20))


def available_cores() -> int:
    """Cores this process may use (at least 1); a container or `taskset` may allow fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def set_threads(threads: int) -> int:
    """Set the number of torch's compute threads, 0 leaves torch's choice, and return the number in force."""
    import torch

    if threads < 0:
        raise ValueError(f"threads: got {threads}, expected 0 (torch's choice) or more")
    if threads:
        torch.set_num_threads(threads)
    return torch.get_num_threads()


def tune_allocator() -> bool:
    """Have glibc's allocator keep freed memory for the next tensor; whether it took effect, False without glibc.

    glibc hands every large tensor back to the system, and the next step pays for its pages again: a paper-size dynamics
    step went from 6.1 s to 2.5 s, with the same results. It cannot be undone in the process; spawned workers have to
    call it themselves.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    mallopt.argtypes = [ctypes.c_int, ctypes.c_int]
    mallopt.restype = ctypes.c_int
    accepted = [mallopt(name, value) == 1 for name, value in _MALLOC]  # all of them, even where one is refused
    return all(accepted)
