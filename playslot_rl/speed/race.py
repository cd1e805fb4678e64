"""Variants of a case against each other: one process each, one step at a time, in turns.

The children are forked from one server that has imported torch and done nothing else, so a dozen of them start at once
and from the same memory. Forking is safe there: the server has no compute threads.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from statistics import median
from typing import Any

from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.allocator import tune_allocator
from playslot_rl.runtime.children import worker_context
from playslot_rl.runtime.threads import set_threads
from playslot_rl.speed.cases import Sizes, Variant


def serve(pipe: Connection[Any, Any], variant: Variant, sizes: Sizes, threads: int) -> None:
    """Body of a child: says that it is ready, then computes one step for each request, until the pipe closes."""
    try:
        # Before torch allocates anything.
        ready = {"allocator": variant.allocator and tune_allocator(), "threads": set_threads(threads)}
        from playslot_rl.speed.cases import build_step

        step = build_step(variant, sizes)
        pipe.send(ready)
        while True:
            pipe.recv()
            begin = time.perf_counter()
            value = float(step())
            pipe.send({"seconds": time.perf_counter() - begin, "value": value})
    except (EOFError, KeyboardInterrupt):
        return
    except (RuntimeError, ValueError) as error:  # told to the parent, which stops with it; torch raises these
        pipe.send({"error": f"{type(error).__name__}({' '.join(str(error).split())})"})


@dataclass
class Child:
    """A running variant: `ask` makes it compute one step."""

    name: str
    process: ForkServerProcess
    pipe: Connection[Any, Any]
    seconds: list[float] = field(default_factory=list)

    def ask(self) -> None:
        """Have one step computed, wait for its end, and keep its seconds."""
        self.begin()
        self.seconds.append(self.answer()["seconds"])

    def begin(self) -> None:
        """Have one step computed; its seconds are the next `answer`."""
        with suppress(BrokenPipeError):  # `answer` says why
            self.pipe.send("go")

    def answer(self) -> dict[str, Any]:
        """What the child sends next.

        Raises:
            PlaySlotError: it failed, or was killed.
        """
        try:
            answer: dict[str, Any] = self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            raise PlaySlotError(
                f"bench: variant {self.name}: got exit code {self.process.exitcode}, expected a time; "
                "if it was killed for want of memory, close other programs and try again"
            ) from None
        if "error" in answer:
            raise PlaySlotError(f"bench: variant {self.name}: got {answer['error']}, expected a time")
        return answer


@contextmanager
def start(name: str, variant: Variant, sizes: Sizes, threads: int) -> Iterator[Child]:
    """Start the process of a variant; it ends with the block."""
    context = worker_context(["playslot_rl.speed.cases"])
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, variant, sizes, threads), daemon=True)
    with _no_malloc_settings():
        process.start()
    theirs.close()
    try:
        yield Child(name, process, ours)
    finally:
        ours.close()
        process.kill()
        process.join()


@contextmanager
def _no_malloc_settings() -> Iterator[None]:
    """The variant says whether the allocator is tuned; the caller's environment, which the server copies, must not."""
    names = [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]
    kept = {name: os.environ.pop(name) for name in names}
    try:
        yield
    finally:
        os.environ.update(kept)


def race(variants: Mapping[str, Variant], sizes: Sizes, threads: int = 0) -> dict[str, float]:
    """Median seconds a step of each variant.

    Args:
        variants: by name; all of one case.
        sizes: sizes and repeats.
        threads: torch threads of each child; 0 leaves torch's choice.

    Raises:
        PlaySlotError: a child failed or was killed.
    """
    with ExitStack() as stack:
        children = [stack.enter_context(start(name, v, sizes, threads)) for name, v in variants.items()]
        for child in children:
            child.answer()
        for _ in range(sizes.repeats + 1):
            for child in children:
                child.ask()
        return {child.name: median(child.seconds[1:]) for child in children}
