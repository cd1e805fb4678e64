"""Seconds of a call."""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any, Final

import torch
from torch.utils.benchmark import Timer

SHORTEST: Final = 0.2
"""Seconds that a measurement takes at least, after calls that are not counted."""


def seconds(call: Callable[[], Any], number: int = 0) -> float:
    """Median seconds of a call, on a GPU to its end; `number` of them in a row, or 0 for as many as it takes."""
    timer = Timer("call()", globals={"call": call}, num_threads=torch.get_num_threads())
    return timer.timeit(number).median if number else timer.blocked_autorange(min_run_time=SHORTEST).median


def timed(make: Callable[[], Callable[[], Any]], device: torch.device, number: int) -> tuple[float, int | None]:
    """Seconds of each of `number` calls in a row of what `make` makes, and the bytes that tensors took on the device at
    most, from the making on (None on a CPU)."""
    on_gpu = device.type == "cuda"
    if on_gpu:
        gc.collect()  # graphs of before
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    took = seconds(make(), number)
    return took, torch.cuda.max_memory_allocated(device) if on_gpu else None


def in_turns(calls: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each call; they take turns, so that all see the same state of the machine."""
    found = [{name: seconds(call) for name, call in calls.items()} for _ in range(rounds)]
    return {name: median(each[name] for each in found) for name in calls}
