"""Workers on a Ray cluster, each an actor with a collector of its own that is asked for one episode at a time.

The cluster's machines need this package (the same version, since episodes are functions of seed and code) and a GL
backend; no shared disk: episodes come back encoded, and this process stores them.
"""

from __future__ import annotations

import contextlib
from typing import Any

from playslot_rl.collectors.episodes import EpisodeCollector
from playslot_rl.collectors.journal import CollectionSpec, Journal, encode
from playslot_rl.collectors.recording import Report
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.ray_cluster import RayCluster, worker_cannot_start
from playslot_rl.storage.atomic import write_bytes


class RemoteEpisodeCollector:
    """A Ray actor's body."""

    def __init__(self, spec: CollectionSpec) -> None:
        import torch

        torch.set_num_threads(1)
        self._collector = EpisodeCollector(spec)

    def record(self, index: int) -> tuple[int, bytes]:
        """Index and encoded content of one episode (see `EpisodeCollector.record`)."""
        return index, encode(self._collector.record(index))


class RayWorkers:
    """Actors of a Ray cluster, one core each; without an address that of `$RAY_ADDRESS`, or of this machine alone.

    Raises:
        ConfigError: Ray is not installed.
        PlaySlotError: the cluster cannot be reached.
    """

    def __init__(self, journal: Journal, count: int, address: str = "") -> None:
        self.journal = journal
        self._tasks: dict[Any, int] = {}
        self._actors: list[Any] = [None] * count
        self._ours = RayCluster.find(address, count).connect()

    def start(self, slot: int) -> None:
        import ray

        made = ray.remote(num_cpus=1, max_restarts=0)(RemoteEpisodeCollector)  # we start another one ourselves
        self._actors[slot] = made.remote(self.journal.spec)

    def submit(self, slot: int, index: int) -> None:
        self._tasks[self._actors[slot].record.remote(index)] = slot

    def reports(self, timeout: float) -> list[Report]:
        import ray

        waiting = list(self._tasks)
        ready, _ = ray.wait(waiting, num_returns=len(waiting), timeout=0)
        if not ready:
            ready, _ = ray.wait(waiting, num_returns=1, timeout=timeout)
        return [self._read(task) for task in ready if task in self._tasks]

    def _read(self, task: Any) -> Report:
        import ray

        slot = self._tasks.pop(task)
        try:
            index, content = ray.get(task)
        except ray.exceptions.ActorDiedError as error:
            if (cause := worker_cannot_start(error)) is not None:
                return Report(slot, error=cause)
            self.kill(slot)
            return Report(slot, dead="on Ray died")
        except ray.exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, PlaySlotError):
                return Report(slot, error=cause)
            return Report(slot, error=RuntimeError(f"{type(cause).__name__}: {cause}"))
        except ray.exceptions.RayError as error:
            self.kill(slot)
            return Report(slot, dead=f"on Ray was lost ({type(error).__name__})")
        write_bytes(self.journal.path(index), content)
        return Report(slot, index=index)

    def kill(self, slot: int) -> None:
        import ray

        actor, self._actors[slot] = self._actors[slot], None
        self._tasks = {task: owner for task, owner in self._tasks.items() if owner != slot}
        if actor is not None:
            with contextlib.suppress(ray.exceptions.RayError):
                ray.kill(actor)

    def close(self) -> None:
        """End the actors, and Ray too if it was started here."""
        import ray

        for slot in range(len(self._actors)):
            self.kill(slot)
        if self._ours:
            ray.shutdown()
