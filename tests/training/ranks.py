"""Several ranks on this machine, forked from this process, which has paid for the imports."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from playslot_rl.runtime import processes

TIMEOUT_S = 300


def run_ranks(world: int, work: Callable[..., None], *arguments: Any) -> list[int]:
    """`work(*arguments)` on so many ranks with a gloo group; the exit codes, by rank."""
    context, port = multiprocessing.get_context("fork"), processes.free_port()
    ranks = [context.Process(target=_rank, args=(rank, world, port, work, arguments)) for rank in range(world)]
    for process in ranks:
        process.start()
    try:
        for process in ranks:
            process.join(TIMEOUT_S)
    finally:
        for process in ranks:
            process.kill()
    return [process.exitcode or 0 for process in ranks]


def launcher_variables(rank: int, world: int, port: int) -> dict[str, str]:
    """The environment that torchrun gives process `rank` of `world` on one machine, which meet at `port`."""
    numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": world, "LOCAL_WORLD_SIZE": world, "MASTER_PORT": port}
    return {"MASTER_ADDR": "127.0.0.1", **{name: str(number) for name, number in numbers.items()}}


def _rank(rank: int, world: int, port: int, work: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    import torch

    torch.set_num_threads(1)
    os.environ |= launcher_variables(rank, world, port)
    try:
        processes.start("cpu")
        work(*arguments)
        processes.stop()
    except BaseException:  # noqa: BLE001
        traceback.print_exc(file=sys.__stderr__)
        os._exit(1)
    os._exit(0)


class _Several(int):
    """One that is taken for more, where it is asked for by `== 1` and `> 1`."""

    __hash__ = int.__hash__

    def __eq__(self, other: object) -> bool:
        return False

    def __gt__(self, other: int) -> bool:
        return True


@contextlib.contextmanager
def alone_in_a_group(backend: str) -> Iterator[None]:
    """Inside the block this process makes all exchanges of one of several, in a group of its own."""
    import torch.distributed as dist

    dist.init_process_group(backend, store=dist.HashStore(), rank=0, world_size=1)
    processes._here = processes.Processes(0, _Several(1))
    try:
        yield
    finally:
        processes._here = processes.Processes()
        dist.destroy_process_group()


def log_of(folder: Path) -> list[dict[str, Any]]:
    """What a training logged, less the times."""
    from playslot_rl.training.logging import History

    rows = History(folder / "metrics.jsonl").read()
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]
