"""Workers that answer calls: processes of this machine, or actors of a Ray cluster. One that dies or hangs is replaced.

Each has a body of its own, and answers the calls it is given in their order. What a lost one had in hand, its successor
is asked, so that answers must be functions of their calls alone.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from playslot_rl.config import CollectorConfig
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.processes import begin_worker, worker_context
from playslot_rl.runtime.ray_cluster import RayCluster, worker_cannot_start

POLL_S = 1.0
START_S = 300.0
"""What a worker is given to import everything, beyond `collector.timeout_s`."""
Make = Callable[[], Callable[..., Any]]
"""Makes, in a worker, what answers its calls; pickled."""
Call = tuple[Any, ...]


class Body:
    """What a worker is: made when it is first called; a call without arguments asks for nothing else."""

    def __init__(self, make: Make) -> None:
        self._make = make
        self._answer: Callable[..., Any] | None = None

    def answer(self, *asked: Any) -> Any:
        if self._answer is None:
            import torch

            torch.set_num_threads(1)
            self._answer = self._make()
        return self._answer(*asked) if asked else None


_body: Body | None = None


def _begin(make: Make) -> None:
    global _body
    begin_worker()
    _body = Body(make)


def _answer(*asked: Any) -> Any:
    assert _body is not None
    return _body.answer(*asked)


class LocalWorker:
    """A process of this machine."""

    def __init__(self, make: Make) -> None:
        self._pool = ProcessPoolExecutor(1, worker_context(), _begin, (make,))
        self.ready = self._pool.submit(_answer)
        (self.process,) = self._pool._processes.values()

    def submit(self, asked: Call) -> Future[Any]:
        try:
            return self._pool.submit(_answer, *asked)
        except BrokenProcessPool as error:  # it died while it had nothing to do
            failed: Future[Any] = Future()
            failed.set_exception(error)
            return failed

    def lost(self, error: Exception) -> str:
        """How it ended, as the error of a call says; one that the body raised is raised."""
        if not isinstance(error, BrokenProcessPool):
            raise error
        self.close()
        code = self.process.exitcode
        ending = f"exit code {code}"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                ending = signal.Signals(-code).name
        return f"ended with {ending}"

    def close(self) -> None:
        """End it at once, also while it works or hangs."""
        self.process.kill()  # SIGKILL: also ends one that is stopped
        self._pool.shutdown(cancel_futures=True)  # and wait: what is left to the garbage collector may leak semaphores


class RayWorker:
    """An actor on one core of a Ray cluster, whose machines need this package."""

    def __init__(self, make: Make) -> None:
        import ray

        made = ray.remote(num_cpus=1, max_restarts=0)(Body)  # we start another one ourselves
        self._actor: Any = made.remote(make)
        self.ready = self.submit(())

    def submit(self, asked: Call) -> Future[Any]:
        found: Future[Any] = self._actor.answer.remote(*asked).future()
        return found

    def lost(self, error: Exception) -> str:
        """As of a `LocalWorker`; one that could not start is a PlaySlotError."""
        import ray

        if isinstance(error, ray.exceptions.RayTaskError) or not isinstance(error, ray.exceptions.RayError):
            told = getattr(error, "cause", None)  # Ray wraps it in its own, of many lines
            raise told if isinstance(told, PlaySlotError) else error
        if (cause := worker_cannot_start(error)) is not None:
            raise cause from error
        return f"on Ray was lost ({type(error).__name__})"

    def close(self) -> None:
        import ray

        with contextlib.suppress(ray.exceptions.RayError):
            ray.kill(self._actor)


@dataclass
class _Place:
    """A worker, its calls with their answers to come, and for how long it has been silent while it had some."""

    worker: LocalWorker | RayWorker
    calls: deque[tuple[Call, Future[Any]]] = field(default_factory=deque)
    silent_s: float = 0.0
    starting: bool = True


class Workers:
    """`count` workers of `collector.backend`; `told` hears of each that is replaced: why, and its calls.

    Raises:
        ConfigError: Ray is asked for and not installed.
        PlaySlotError: its cluster cannot be reached.
    """

    def __init__(
        self,
        make: Make,
        count: int,
        settings: CollectorConfig,
        told: Callable[[str, Sequence[Call]], None] = lambda _why, _calls: None,
    ) -> None:
        self.make, self.settings, self.told, self.replaced = make, settings, told, 0
        self._ray = RayCluster.find(settings.ray_address, count) if settings.backend == "ray" else None
        self._ours = self._ray is not None and self._ray.connect()
        self._places = [_Place(self._made()) for _ in range(count)]

    def __len__(self) -> int:
        return len(self._places)

    @property
    def busy(self) -> bool:
        return any(place.calls for place in self._places)

    def in_hand(self, number: int) -> int:
        """Calls that a worker has not answered yet."""
        return len(self._places[number].calls)

    def submit(self, number: int, *asked: Any) -> None:
        place = self._places[number]
        place.calls.append((asked, place.worker.submit(asked)))

    def answers(self) -> Iterator[tuple[Call, Any]]:
        """Calls with their answers, of all that come within `POLL_S`; then who died or hangs has been replaced.

        Raises:
            PlaySlotError: more workers died or hung than `collector.restarts`, or one cannot start.
            Exception: what a body raised.
        """
        began = time.monotonic()
        wait([future for place in self._places for _, future in place.calls], POLL_S, FIRST_COMPLETED)
        # Time in which this process was itself stopped, or busy with the caller's work, is nobody's silence.
        waited = min(time.monotonic() - began, 2 * POLL_S)
        for number, place in enumerate(self._places):
            place.silent_s += waited if place.calls else 0.0
            if place.starting and place.worker.ready.done():
                place.starting, place.silent_s = False, 0.0
            while place.calls and place.calls[0][1].done():
                try:
                    answer = place.calls[0][1].result()
                except Exception as error:  # noqa: BLE001  raised again, unless it says that the worker is lost
                    self._replace(number, place.worker.lost(error))
                    break
                place.silent_s = 0.0
                yield place.calls.popleft()[0], answer
            else:
                if place.silent_s >= self.settings.timeout_s + START_S * place.starting:
                    self._replace(number, f"gave no answer for {self.settings.timeout_s:g} s")

    def close(self) -> None:
        """End all at once, and Ray too if it was started here; calls in hand are lost."""
        for place in self._places:
            place.worker.close()
        self._places = []
        if self._ours:
            import ray

            ray.shutdown()

    def _made(self) -> LocalWorker | RayWorker:
        return LocalWorker(self.make) if self._ray is None else RayWorker(self.make)

    def _replace(self, number: int, reason: str) -> None:
        place = self._places[number]
        place.worker.close()
        if self.replaced >= self.settings.restarts:
            raise PlaySlotError(
                f"a worker {reason}, after {self.replaced} were replaced: got more than collector.restarts="
                f"{self.settings.restarts}, expected workers that live; the same command carries on"
            )
        self.replaced += 1
        asked = [call for call, _ in place.calls]
        self.told(reason, asked)
        self._places[number] = _Place(self._made())
        for call in asked:
            self.submit(number, *call)
