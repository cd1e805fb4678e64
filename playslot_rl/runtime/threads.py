"""Torch threads and cores of this process."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Cores this process may use (at least 1); a container or `taskset` may allow fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def set_threads(threads: int) -> int:
    """Set the number of torch's compute threads.

    Args:
        threads: number of threads; 0 leaves torch's choice.

    Returns:
        The number in force.

    Raises:
        ValueError: a negative number.
    """
    import torch

    if threads < 0:
        raise ValueError(f"threads: got {threads}, expected 0 (torch's choice) or more")
    if threads:
        torch.set_num_threads(threads)
    return torch.get_num_threads()
