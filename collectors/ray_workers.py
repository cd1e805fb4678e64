"""Workers on a Ray cluster: TorchRL's `RayCollector`, whose remote collectors are asked for one episode at a time.

The cluster's machines need this package (the same version, since episodes are functions of seed and code) and a GL
backend; no shared disk: episodes come back encoded, and this process stores them.
"""

from __future__ import annotations

import contextlib
from functools import partial
from typing import Any

from playslot_rl.collectors.episodes import EpisodeCollector, TaskMaker, collector_settings, make_policy
from playslot_rl.collectors.journal import Journal, encode
from playslot_rl.collectors.recording import Report
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.ray_cluster import RayCluster, worker_cannot_start
from playslot_rl.storage.atomic import write_bytes


class RemoteEpisodeCollector(EpisodeCollector):
    """The collector in a Ray actor."""

    def record_encoded(self, index: int) -> tuple[int, bytes]:
        """Index and encoded content of one episode (see `EpisodeCollector.record`)."""
        import torch

        torch.set_num_threads(1)
        return index, encode(self.record(index))


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
        self._pool = RayCluster.find(address, count).connect(partial(_collector, journal))

    def start(self, slot: int) -> None:
        spec = self.journal.spec
        resources = {"num_cpus": 1, "max_restarts": 0}  # we start another one ourselves, and know its episodes
        self._pool.add_collectors([TaskMaker(spec)], 1, make_policy(spec), [collector_settings(spec)], [resources])
        self._actors[slot] = self._pool.remote_collectors[-1]

    def submit(self, slot: int, index: int) -> None:
        self._tasks[self._actors[slot].record_encoded.remote(index)] = slot

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
            self._pool.remote_collectors.remove(actor)
            with contextlib.suppress(ray.exceptions.RayError):
                ray.kill(actor)

    def close(self) -> None:
        """End the actors, and Ray too if it was started here."""
        self._tasks = {}
        self._pool.shutdown()


def _collector(journal: Journal, init: dict[str, Any]) -> Any:
    """TorchRL's Ray collector, without actors yet."""
    from torchrl.collectors.distributed import RayCollector

    return RayCollector(
        [],
        make_policy(journal.spec),
        collector_class=RemoteEpisodeCollector,
        frames_per_batch=journal.spec.steps,
        collector_kwargs=[],
        remote_configs=[],
        ray_init_config=init,
        weight_sync_schemes={},
    )
