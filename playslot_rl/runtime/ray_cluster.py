"""Reaching a Ray cluster, or starting one of this machine alone: every fault is one line."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import warnings
from dataclasses import dataclass
from typing import Any

from playslot_rl.errors import ConfigError, PlaySlotError

CONNECT_S = 10.0
STARTS = 3
"""Attempts to start Ray on this machine: it gives its own processes 30 seconds, too few where all cores are busy."""


@dataclass(frozen=True)
class RayCluster:
    """A cluster to be connected to: its address, empty for this machine alone, where it is started and ended by who
    asked; and the arguments of `ray.init`.
    """

    where: str
    init: dict[str, Any]

    @classmethod
    def find(cls, address: str, count: int) -> RayCluster:
        """Look for the cluster, without connecting. No `address` means `$RAY_ADDRESS`, or a cluster of this machine
        alone, of `count` cores.

        Raises:
            ConfigError: Ray is not installed.
            PlaySlotError: nobody listens at the address.
        """
        if importlib.util.find_spec("ray") is None:
            raise ConfigError(
                "collector.backend=ray: got no ray package, expected ray 2.60; pip install 'playslot_rl[ray]', "
                "or use collector.backend=local"
            )
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray announces a change of its own
        where = address or os.environ.get("RAY_ADDRESS", "")
        host, colon, port = where.removeprefix("ray://").rpartition(":")
        if colon and port.isdigit():  # "auto" and the like are Ray's to judge
            try:  # whether anybody listens: Ray itself would try for minutes
                socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
            except (OSError, OverflowError) as error:
                raise PlaySlotError(_no_cluster(where, error)) from error
        quiet: dict[str, Any] = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}
        return cls(where, quiet | ({"address": where} if where else {"address": "local", "num_cpus": count}))

    def connect(self) -> bool:
        """Connect, and say whether this process was not before, so that who asked ends it; a PlaySlotError where the
        cluster cannot be reached, or this machine's does not start.
        """
        import ray

        if ray.is_initialized():
            return False
        for attempt in range(1 if self.where else STARTS):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    ray.init(**self.init)
                return True
            except Exception as error:  # a node that does not start in time is a plain Exception
                with contextlib.suppress(Exception):
                    ray.shutdown()
                if self.where or attempt == STARTS - 1:
                    raise PlaySlotError(_no_cluster(self.where, error)) from error
        raise AssertionError("unreachable")


def worker_cannot_start(error: Exception) -> PlaySlotError | None:
    """What to tell of an actor that died while it was made; None if it died later."""
    text = str(error)
    if "ModuleNotFoundError" not in text and "creation task" not in text:
        return None
    last = next((line for line in reversed(text.splitlines()) if line.strip()), "no reason given")
    return PlaySlotError(
        f"collector.backend=ray: a worker could not start, got {last.strip()}, expected playslot_rl of "
        "this version and a GL backend on every machine of the cluster; install them there"
    )


def _no_cluster(where: str, error: Exception) -> str:
    text = " ".join(str(error).split())
    if not where:
        return f"collector.backend=ray: got {text}, expected Ray to start on this machine; use collector.backend=local"
    return (
        f"collector.backend=ray: got {text}, expected a cluster at {where!r}; "
        "check collector.ray_address, or leave it out to use this machine alone"
    )
