"""Variants against each other: one process each (the allocator's setting cannot be undone in one), in turns.

The children are forked from one server that has imported torch and done nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from statistics import median

from ranks import launcher_variables
from variants import Variant, build_step

from playslot_rl.runtime.processes import begin_worker, free_port, start, worker_context
from playslot_rl.runtime.threads import set_threads, tune_allocator
from playslot_rl.speed.cases import Sizes
from playslot_rl.speed.steps import Step
from playslot_rl.speed.timing import seconds

Teams = Mapping[str, Sequence[Variant]]
"""The processes of each side; several of them share each step."""


def race(teams: Teams, sizes: Sizes, threads: int = 0) -> dict[str, float]:
    """Median seconds a step of each team: of several processes, those of the slowest."""
    found: dict[str, list[float]] = {name: [] for name in teams}
    together = any(len(team) > 1 for team in teams.values())  # then all count their steps alike
    with children(teams, sizes, threads) as running:
        for _ in range(sizes.rounds):
            for name, team in running.items():
                answers = [child.submit(_time, int(together)) for child in team]
                found[name].append(max(answer.result() for answer in answers))
    return {name: median(times) for name, times in found.items()}


@contextmanager
def children(teams: Teams, sizes: Sizes, threads: int) -> Iterator[dict[str, list[ProcessPoolExecutor]]]:
    """A process for each variant, ready; they end with the block. A team of several shares the threads."""
    context = worker_context(["playslot_rl.speed.cases"])
    with ExitStack() as stack, _no_malloc_settings():
        running: dict[str, list[ProcessPoolExecutor]] = {}
        begun = []
        for name, team in teams.items():
            world, port = len(team), free_port()
            running[name] = [
                stack.enter_context(ProcessPoolExecutor(1, context, initializer=begin_worker)) for _ in team
            ]
            for rank, (variant, child) in enumerate(zip(team, running[name], strict=True)):
                place = launcher_variables(rank, world, port) if world > 1 else {}
                begun.append(child.submit(_begin, variant, sizes, threads // world, place))
        for future in begun:
            future.result()
        yield running


@contextmanager
def _no_malloc_settings() -> Iterator[None]:
    """The variant says whether the allocator is tuned; the caller's environment, which the server copies, must not."""
    names = [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]
    kept = {name: os.environ.pop(name) for name in names}
    try:
        yield
    finally:
        os.environ.update(kept)


_steps: list[Step] = []
"""Of a child: the step of its variant."""


def _begin(variant: Variant, sizes: Sizes, threads: int, place: Mapping[str, str]) -> None:
    if variant.allocator:
        tune_allocator()  # before torch allocates anything
    set_threads(threads)
    if place:
        os.environ.update(place)
        start("cpu")
    _steps.append(build_step(variant, sizes))


def _time(number: int) -> float:
    return seconds(_steps[0], number)


def loss() -> float:
    """In a child: what one step gives."""
    return float(_steps[0]())
