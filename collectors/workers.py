"""Collector processes of this machine.

Each records the episodes it is given and writes their files itself, so that only small messages pass between the
processes: nothing waits for the parent, and a process that stops in the middle of an episode cannot block it.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Protocol

from playslot_rl.collectors.episodes import EpisodeCollector, Job
from playslot_rl.collectors.journal import Journal, store
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.errors import PlaySlotError

PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Report:
    """News of a worker: it stored episode `index`; or ended with an `error`; or died, and of what (`dead`).

    With none of them, it is ready.
    """

    slot: int
    index: int | None = None
    error: Exception | None = None
    dead: str = ""


class Workers(Protocol):
    """Places (slots) where episodes are recorded."""

    def start(self, slot: int) -> None:
        """Start the worker of a place, empty or left by a dead one."""

    def submit(self, slot: int, job: Job) -> None:
        """Hand an episode to a worker, which records its episodes in the order they come."""

    def reports(self, timeout: float) -> list[Report]:
        """What the workers say; empty after `timeout` seconds of silence."""

    def kill(self, slot: int) -> None:
        """End a worker at once, also one that hangs."""

    def close(self) -> None:
        """End all of them."""


def start_worker() -> None:
    """Run first in a worker process: leave Ctrl-C to the parent, die with it, use one core."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() == 1:  # the parent died before the line above
            os._exit(1)


def serve(pipe: Connection[Any, Any], spec: CollectionSpec, folder: Path) -> None:
    """Body of a worker process: record and store what comes through the pipe, until it closes."""
    start_worker()
    try:
        collector = EpisodeCollector.make(spec)
        pipe.send(None)  # ready
        while True:
            job: Job = pipe.recv()
            store(folder, collector.record(job))
            pipe.send(job.index)
    except (EOFError, ConnectionError):
        return
    except Exception as error:  # noqa: BLE001  told to the parent, which ends with it
        with contextlib.suppress(ConnectionError):
            pipe.send(error if isinstance(error, PlaySlotError) else RuntimeError(f"{type(error).__name__}: {error}"))


class LocalWorkers:
    """Worker processes.

    Args:
        journal: where they store episodes.
        count: how many.
    """

    def __init__(self, journal: Journal, count: int) -> None:
        self.journal = journal
        self._context = multiprocessing.get_context("spawn")
        self._processes: list[SpawnProcess | None] = [None] * count
        self._pipes: list[Connection[Any, Any] | None] = [None] * count

    def start(self, slot: int) -> None:
        """See `Workers`."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=serve, args=(theirs, self.journal.spec, self.journal.folder), daemon=True
        )
        process.start()
        theirs.close()
        self._processes[slot], self._pipes[slot] = process, ours

    def submit(self, slot: int, job: Job) -> None:
        """See `Workers`."""
        pipe = self._pipes[slot]
        assert pipe is not None
        with contextlib.suppress(ConnectionError):  # `reports` says that it died
            pipe.send(job)

    def reports(self, timeout: float) -> list[Report]:
        """See `Workers`."""
        open_pipes = [pipe for pipe in self._pipes if pipe is not None]
        ready = wait(open_pipes, timeout)
        return [report for slot, pipe in enumerate(self._pipes) if pipe in ready for report in self._read(slot)]

    def _read(self, slot: int) -> Iterator[Report]:
        pipe, process = self._pipes[slot], self._processes[slot]
        assert pipe is not None
        assert process is not None
        try:
            while pipe.poll():
                said = pipe.recv()
                yield Report(slot, error=said) if isinstance(said, Exception) else Report(slot, index=said)
        except (EOFError, OSError):
            process.join(1.0)
            code = process.exitcode
            self.kill(slot)
            yield Report(slot, dead=f"ended with {_exit_text(code)}")

    def kill(self, slot: int) -> None:
        """See `Workers`."""
        process, pipe = self._processes[slot], self._pipes[slot]
        self._processes[slot] = self._pipes[slot] = None
        if pipe is not None:
            pipe.close()
        if process is not None:
            process.kill()  # SIGKILL: also ends one that is stopped
            process.join()

    def close(self) -> None:
        """See `Workers`. Episodes in hand are lost: a file is whole or not there, so nothing else is."""
        for slot in range(len(self._processes)):
            self.kill(slot)


def _exit_text(code: int | None) -> str:
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"
