"""Workers on a Ray cluster: TorchRL's `RayCollector`, whose remote collectors are asked for one episode at a time.

The cluster's machines need this package (the same version, since episodes are functions of seed and code) and a GL
backend; no shared disk: episodes come back encoded, and this process stores them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import warnings
from typing import Any

from playslot_rl.collectors.episodes import EpisodeCollector, TaskMaker, collector_settings, make_policy
from playslot_rl.collectors.journal import Journal, encode
from playslot_rl.collectors.recording import Report
from playslot_rl.errors import ConfigError, PlaySlotError

CONNECT_S = 10.0
STARTS = 3
"""Attempts to start Ray on this machine: it gives its own processes 30 seconds, too few where all cores are busy."""


class RemoteEpisodeCollector(EpisodeCollector):
    """The collector in a Ray actor."""

    def record_encoded(self, index: int) -> tuple[int, bytes]:
        """Index and encoded content of one episode (see `EpisodeCollector.record`)."""
        import torch

        torch.set_num_threads(1)
        return index, encode(self.record(index))


class RayWorkers:
    """Actors of a Ray cluster, one core each.

    Args:
        journal: where this process stores their episodes.
        count: how many.
        address: of the cluster; empty means `$RAY_ADDRESS`, or a cluster of this machine alone.

    Raises:
        ConfigError: Ray is not installed.
        PlaySlotError: the cluster cannot be reached.
    """

    def __init__(self, journal: Journal, count: int, address: str = "") -> None:
        if importlib.util.find_spec("ray") is None:
            raise ConfigError(
                "collector.backend=ray: got no ray package, expected ray 2.60; pip install 'playslot_rl[ray]', "
                "or use collector.backend=local"
            )
        self.journal = journal
        self._tasks: dict[Any, int] = {}
        self._actors: list[Any] = [None] * count
        self._pool = _connect(journal, count, address)

    def start(self, slot: int) -> None:
        """See `playslot_rl.collectors.recording.Workers`."""
        spec = self.journal.spec
        resources = {"num_cpus": 1, "max_restarts": 0}  # we start another one ourselves, and know its episodes
        self._pool.add_collectors([TaskMaker(spec)], 1, make_policy(spec), [collector_settings(spec)], [resources])
        self._actors[slot] = self._pool.remote_collectors[-1]

    def submit(self, slot: int, index: int) -> None:
        """See `playslot_rl.collectors.recording.Workers`."""
        self._tasks[self._actors[slot].record_encoded.remote(index)] = slot

    def reports(self, timeout: float) -> list[Report]:
        """See `playslot_rl.collectors.recording.Workers`."""
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
            text = str(error)
            if "ModuleNotFoundError" in text or "creation task" in text:
                last = next((line for line in reversed(text.splitlines()) if line.strip()), "no reason given")
                return Report(
                    slot,
                    error=PlaySlotError(
                        f"collector.backend=ray: a worker could not start, got {last.strip()}, expected playslot_rl of "
                        "this version and a GL backend on every machine of the cluster; install them there"
                    ),
                )
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
        self.journal.add_encoded(index, content)
        return Report(slot, index=index)

    def kill(self, slot: int) -> None:
        """See `playslot_rl.collectors.recording.Workers`."""
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


def _connect(journal: Journal, count: int, address: str) -> Any:
    """TorchRL's Ray collector, without actors yet."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray announces a change of its own
    where = address or os.environ.get("RAY_ADDRESS", "")
    alone = not where
    host, colon, port = where.removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():  # "auto" and the like are Ray's to judge
        try:  # whether anybody listens: Ray itself would try for minutes
            socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
        except (OSError, OverflowError) as error:
            raise PlaySlotError(_no_cluster(where, error)) from error
    from torchrl.collectors.distributed import RayCollector

    init: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}
    init |= {"address": "local", "num_cpus": count} if alone else {"address": where}
    for attempt in range(STARTS if alone else 1):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of weight updates: these policies have no weights
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
        except Exception as error:  # a node that does not start in time is a plain Exception
            import ray

            ray.shutdown()
            if not alone or attempt == STARTS - 1:
                raise PlaySlotError(_no_cluster(where, error)) from error
    raise AssertionError("unreachable")


def _no_cluster(where: str, error: Exception) -> str:
    text = " ".join(str(error).split())
    if not where:
        return f"collector.backend=ray: got {text}, expected Ray to start on this machine; use collector.backend=local"
    return (
        f"collector.backend=ray: got {text}, expected a cluster at {where!r}; "
        "check collector.ray_address, or leave it out to use this machine alone"
    )
