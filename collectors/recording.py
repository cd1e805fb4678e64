"""Hands episodes out to workers, and replaces workers that die or hang.

Each worker process records the episodes it is given and writes their files itself, so that only small messages pass:
nothing waits for the parent, and a process that stops in the middle of an episode cannot block it.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from playslot_rl.collectors.episodes import EpisodeCollector, record
from playslot_rl.collectors.journal import CollectionSpec, Journal, RecordedEpisode
from playslot_rl.config import CollectorConfig
from playslot_rl.envs import PROCEDURAL
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.envs.rendering import check_rendering
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.processes import begin_worker, worker_context

if TYPE_CHECKING:
    from playslot_rl.collectors.ray_workers import RayWorkers

AHEAD = 2  # episodes in a worker's hands: while it records one, the next is there already
POLL_S = 1.0
START_S = 300.0  # what a worker is given to import everything, beyond `collector.timeout_s`
CLIPS_AT_ONCE = 64


@dataclass(frozen=True)
class Report:
    """News of a worker: it stored episode `index`; or ended with an `error`; or died, and of what; else it is ready."""

    slot: int
    index: int | None = None
    error: Exception | None = None
    dead: str = ""


def serve(pipe: Connection[Any, Any], journal: Journal) -> None:
    """Body of a worker process: record and store what comes through the pipe, until it closes."""
    begin_worker()
    torch.set_num_threads(1)
    try:
        collector = EpisodeCollector(journal.spec)
        pipe.send(None)  # ready
        while True:
            index: int = pipe.recv()
            journal.add(collector.record(index))
            pipe.send(index)
    except (EOFError, ConnectionError):
        return
    except Exception as error:  # noqa: BLE001  told to the parent, which ends with it
        with contextlib.suppress(ConnectionError):
            pipe.send(error if isinstance(error, PlaySlotError) else RuntimeError(f"{type(error).__name__}: {error}"))


class LocalWorkers:
    """Worker processes, each in a place (slot) where episodes are recorded."""

    def __init__(self, journal: Journal, count: int) -> None:
        self.journal = journal
        self._context = worker_context()
        self._workers: list[tuple[ForkServerProcess, Connection[Any, Any]] | None] = [None] * count

    def start(self, slot: int) -> None:
        """Start the worker of a place, empty or left by a dead one."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=serve, args=(theirs, self.journal), daemon=True)
        process.start()
        theirs.close()
        self._workers[slot] = process, ours

    def submit(self, slot: int, index: int) -> None:
        """Hand an episode to a worker, which records its episodes in the order they come."""
        worker = self._workers[slot]
        assert worker is not None
        with contextlib.suppress(ConnectionError):  # `reports` says that it died
            worker[1].send(index)

    def reports(self, timeout: float) -> list[Report]:
        """What the workers say; empty after `timeout` seconds of silence."""
        ready = wait([worker[1] for worker in self._workers if worker is not None], timeout)
        there = [(slot, *worker) for slot, worker in enumerate(self._workers) if worker is not None]
        return [report for slot, process, pipe in there if pipe in ready for report in self._read(slot, process, pipe)]

    def _read(self, slot: int, process: ForkServerProcess, pipe: Connection[Any, Any]) -> Iterator[Report]:
        try:
            while pipe.poll():
                said = pipe.recv()
                yield Report(slot, error=said) if isinstance(said, Exception) else Report(slot, index=said)
        except (EOFError, OSError):
            process.join(1.0)
            code = process.exitcode
            self.kill(slot)
            ending = f"exit code {code}"
            if code is not None and code < 0:
                with contextlib.suppress(ValueError):
                    ending = signal.Signals(-code).name
            yield Report(slot, dead=f"ended with {ending}")

    def kill(self, slot: int) -> None:
        """End a worker at once, also one that hangs."""
        worker, self._workers[slot] = self._workers[slot], None
        if worker is not None:
            worker[1].close()
            worker[0].kill()  # SIGKILL: also ends one that is stopped
            worker[0].join()

    def close(self) -> None:
        """End all. Episodes in hand are lost: a file is whole or not there, so nothing else is."""
        for slot in range(len(self._workers)):
            self.kill(slot)


def record_into(
    journal: Journal,
    indices: Sequence[int],
    workers: int,
    settings: CollectorConfig | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[int]:
    """Record the episodes `indices` of a journal's collection into it; yields each once, when it is stored.

    Args:
        journal: locked by the caller.
        workers: how many; 1 local one records in this process. The episodes do not depend on it, only their order.

    Raises:
        RenderError: there is no working GL backend.
        ConfigError: every draw of an episode starts solved, or Ray is missing.
        OutputError: full disk.
        PlaySlotError: more workers died or hung than `settings.restarts`.
    """
    settings = settings or CollectorConfig()
    workers = max(1, min(workers, len(indices)))
    if not indices:
        return
    drawn = journal.spec.env.name in PROCEDURAL  # quicker than any pool would start
    if drawn or (settings.backend == "local" and workers == 1):
        for episode in (draw if drawn else record)(journal.spec, indices):
            journal.add(episode)
            yield episode.index
        return
    pool: LocalWorkers | RayWorkers
    if settings.backend == "ray":
        from playslot_rl.collectors.ray_workers import RayWorkers

        pool = RayWorkers(journal, workers, settings.ray_address)
    else:
        check_rendering()  # a missing GL backend is one line here, many in the workers
        pool = LocalWorkers(journal, workers)
    try:
        yield from _Dispatch(pool, journal, indices, workers, settings, say).run()
    finally:
        pool.close()


def draw(spec: CollectionSpec, indices: Sequence[int]) -> Iterator[RecordedEpisode]:
    """Draw the episodes `indices` of an environment without a simulator (GridShapes): no policy, no workers.

    Actions say what the objects did, states where they were; reward and success are zero.
    """
    for first in range(0, len(indices), CLIPS_AT_ONCE):
        some = indices[first : first + CLIPS_AT_ONCE]
        seeds = [spec.episode_seed(index) for index in some]
        clips = generate(seeds, spec.steps, spec.env)
        for number, (index, seed) in enumerate(zip(some, seeds, strict=True)):
            yield RecordedEpisode(
                index=index,
                seed=seed,
                redrawn=0,
                frames=clips.frames[number],
                states=clips.states[number],
                actions=clips.actions[number],
                rewards=np.zeros(spec.steps, np.float32),
                success=np.zeros(spec.steps, np.bool_),
            )


class _Dispatch:
    """Which episodes wait, which are in whose hands, and for how long each worker has been silent."""

    def __init__(
        self,
        pool: LocalWorkers | RayWorkers,
        journal: Journal,
        indices: Sequence[int],
        workers: int,
        settings: CollectorConfig,
        say: Callable[[str], None],
    ) -> None:
        self.pool, self.journal, self.settings, self.say = pool, journal, settings, say
        self.waiting = deque(sorted(set(indices)))
        self.in_hand: list[list[int]] = [[] for _ in range(workers)]
        self.silent_s = [0.0] * workers
        self.started = [False] * workers
        self.replaced = 0

    def run(self) -> Iterator[int]:
        for slot in range(len(self.in_hand)):
            self.pool.start(slot)
        while self.waiting or any(self.in_hand):
            self._hand_out()
            begin = time.monotonic()
            reports = self.pool.reports(POLL_S)
            # Time in which this process was itself stopped, or busy with the caller's work, is nobody's silence.
            waited = min(time.monotonic() - begin, 2 * POLL_S)
            for slot, held in enumerate(self.in_hand):
                self.silent_s[slot] += waited if held else 0.0
            for report in reports:
                index = self._take(report)
                if index is not None:
                    yield index
            self._replace_silent()

    def _hand_out(self) -> None:
        # The last episodes go to whoever is free, not on top of another.
        ahead = AHEAD if len(self.waiting) > len(self.in_hand) else 1
        for depth in range(ahead):
            for slot, held in enumerate(self.in_hand):
                if len(held) <= depth and self.waiting:
                    index = self.waiting.popleft()
                    held.append(index)
                    self.pool.submit(slot, index)

    def _take(self, report: Report) -> int | None:
        """A report's episode, if it stored one."""
        self.silent_s[report.slot], self.started[report.slot] = 0.0, True
        if report.error is not None:
            raise report.error
        if report.dead:
            self._replace(report.slot, report.dead)
        if report.index is None:
            return None
        self.in_hand[report.slot].remove(report.index)
        return report.index

    def _replace_silent(self) -> None:
        for slot, silent in enumerate(self.silent_s):
            if silent >= self.settings.timeout_s + (0.0 if self.started[slot] else START_S):
                self.pool.kill(slot)
                self._replace(slot, f"gave no episode for {self.settings.timeout_s:g} s")

    def _replace(self, slot: int, reason: str) -> None:
        """Start another worker in a dead one's place; its episodes wait again."""
        lost = sorted(self.in_hand[slot])
        self.waiting.extendleft(reversed(lost))
        self.in_hand[slot], self.silent_s[slot], self.started[slot] = [], 0.0, False
        if self.replaced >= self.settings.restarts:
            raise PlaySlotError(
                f"a collector worker {reason}, after {self.replaced} were replaced: got more than collector.restarts="
                f"{self.settings.restarts}, expected workers that live; the same command carries on"
            )
        self.replaced += 1
        names = ", ".join(map(str, lost))
        self.say(f"a worker {reason}: another takes its place (episodes in hand: {names or 'none'})")
        self.pool.start(slot)
