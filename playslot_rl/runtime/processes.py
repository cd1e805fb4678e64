"""The processes of one training, and those that a command starts for its work.

The former are started by `torchrun` or `accelerate launch`, each with its own slice of every batch.

    g = 1/W sum_r g_r,   g_r the gradient of the mean over the rows of rank r

Hugging Face accelerate opens the process group; what is exchanged is small (models of some million parameters, one flat
vector a step). Without a launcher there is one process, and nothing of this does anything. Every exchange raises a
PeerError where another process has ended.

Shapes: W processes ("world"), r rank of one of them, from 0.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from playslot_rl.errors import ConfigError, PeerError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

TIMEOUT: Final = timedelta(minutes=10)
"""How long a process waits for the others: longer than a validation's batch or a checkpoint takes. One that dies is
noticed at once, by its closed connection."""


@dataclass(frozen=True)
class Processes:
    """Which of the processes this is: r, and W."""

    rank: int = 0
    world: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the one that writes and prints."""
        return self.rank == 0


_here = Processes()
_spreading = False


def here() -> Processes:
    """This process among those of the training; the only one unless `start` was called."""
    return _here


def launched() -> Processes:
    """What a launcher's environment says, whether or not `start` was called; no launcher sets what is no number."""
    try:
        return Processes(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    except ValueError:
        return Processes()


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def start(device: str = "") -> None:
    """Meet the other processes. From then on only the first one prints to standard output.

    Each process of a machine has a GPU of its own, where there are some and `device` is not `cpu`; a ConfigError where
    there are fewer.
    """
    global _here
    if launched().world == 1:
        return
    import torch
    from accelerate import Accelerator
    from accelerate.utils import InitProcessGroupKwargs

    on_cpu = device == "cpu" or not torch.cuda.is_available()
    own, gpus = int(os.environ.get("LOCAL_WORLD_SIZE", "1")), torch.cuda.device_count()
    if not on_cpu and own > gpus:
        raise ConfigError(
            f"got {own} processes on a machine with {gpus} GPU{'s' * (gpus > 1)}, expected at most one each: start "
            f"{gpus} (torchrun --nproc-per-node={gpus}), or let them meet on the CPU (device=cpu)"
        )
    # Without `cpu=True` accelerate takes every process on a CPU for the only one.
    engine = Accelerator(cpu=on_cpu, kwargs_handlers=[InitProcessGroupKwargs(timeout=TIMEOUT)])
    _here = Processes(engine.process_index, engine.num_processes)
    if not _here.first:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115


def stop() -> None:
    """Part from the others, at the end of a command that went well."""
    global _here
    if _here.world > 1:
        import torch.distributed as dist
        from accelerate.state import AcceleratorState, PartialState

        dist.destroy_process_group()
        AcceleratorState._reset_state(reset_partial_state=True)
        PartialState._reset_state()
        _here = Processes()


def wait() -> None:
    """Until all are here."""
    if _here.world > 1:
        import torch
        import torch.distributed as dist

        # NCCL would guess the GPU from the rank, and say so.
        own = [torch.cuda.current_device()] if dist.get_backend() == "nccl" else None
        with _exchange():
            dist.barrier(device_ids=own)


def own_device(device: torch.device) -> torch.device:
    """`cuda` as the GPU of this process; any other device as it is."""
    import torch

    if _here.world == 1 or str(device) != "cuda":
        return device
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def summed(values: Tensor) -> Tensor:
    """Sum over the processes, in place; no gradient."""
    if _here.world > 1:
        import torch.distributed as dist

        with _exchange():
            dist.all_reduce(values)
    return values


def stacked(values: Tensor) -> Tensor:
    """The tensors (b, ...) of all processes, rank by rank: (W b, ...); no gradient."""
    if _here.world == 1:
        return values
    import torch
    import torch.distributed as dist

    parts = [torch.empty_like(values, memory_format=torch.contiguous_format) for _ in range(_here.world)]
    with _exchange():
        dist.all_gather(parts, values.contiguous())
    return torch.cat(parts)


def agreed(number: int) -> list[int]:
    """This number of every process, by rank."""
    if _here.world == 1:
        return [number]
    import torch.distributed as dist

    found = [0] * _here.world
    with _exchange():
        dist.all_gather_object(found, number)
    return found


def copied(tensors: Sequence[Tensor]) -> None:
    """Give all processes the first one's tensors, in place."""
    if _here.world == 1:
        return
    import torch
    import torch.distributed as dist

    for tensor in tensors:
        whole = tensor.detach().clone(memory_format=torch.contiguous_format)
        with _exchange():
            dist.broadcast(whole, src=0)
        tensor.detach().copy_(whole)


def recordable() -> bool:
    """Whether a CUDA graph can hold what is exchanged: NCCL's exchanges are kernels, gloo's are the host's work."""
    if _here.world == 1:
        return True
    import torch.distributed as dist

    return "nccl" in dist.get_backend()


def claim(what: str) -> bool:
    """Whether this process is the first one to ask for `what`: always, where it is the only one or has met no others.

    Nobody is waited for. Where the process that keeps the list has ended, this one is not the first.
    """
    if _here.world == 1:
        return True
    from torch.distributed.distributed_c10d import _get_default_store

    try:
        return _get_default_store().add(f"playslot/{what}", 1) == 1
    except RuntimeError:
        return False


@contextlib.contextmanager
def spreading() -> Iterator[None]:
    """Inside the block `spread` shares its items out."""
    global _spreading
    _spreading = _here.world > 1
    try:
        yield
    finally:
        _spreading = False


def spread[Item, Result](items: Sequence[Item], compute: Callable[[int, Item], Result]) -> list[Result]:
    """`compute(number, item)` of all items, in order: each is computed by one process, and all get all results.

    Outside of `spreading`, and without other processes, this one computes them all. Every process must come here with
    the same items. Tensors among shared results are on the CPU.
    """
    if not _spreading:
        return [compute(number, item) for number, item in enumerate(items)]
    import torch
    import torch.distributed as dist
    from torch.utils._pytree import tree_map_only

    own = range(_here.rank, len(items), _here.world)
    mine = {number: tree_map_only(torch.Tensor, torch.Tensor.cpu, compute(number, items[number])) for number in own}
    gathered: list[Any] = [None] * _here.world
    with _exchange():
        dist.all_gather_object(gathered, mine)
    found = {number: result for part in gathered for number, result in part.items()}
    return [found[number] for number in range(len(items))]


@contextlib.contextmanager
def _exchange() -> Iterator[None]:
    """Say what a failed exchange means: gloo and NCCL give a page about sockets. What NCCL adds of its own is kept."""
    try:
        yield
    except RuntimeError as error:
        words = str(error).partition("Last error:")[2].split("\n")
        own = next((f" (NCCL: {line.strip()})" for line in words if line.strip()), "")
        raise PeerError(
            f"rank {_here.rank} of {_here.world}: another process ended or did not answer within "
            f"{TIMEOUT.seconds // 60} minutes{own}; its own line says why; the same command carries on"
        ) from error


PR_SET_PDEATHSIG: Final = 1
IMPORTED: Final = ("torchrl.envs",)
"""What every worker needs and takes seconds to import; with it torch and tensordict."""


def worker_context(imported: Sequence[str] = IMPORTED) -> ForkServerContext:
    """How workers start: forked from one server, which has the imports, and no thread, GL context or GPU.

    The first worker starts as quickly as a fresh process, each further one in tens of milliseconds, and all of them
    share the memory of the imports. The workers end with this process (`begin_worker`), and the server with them. A
    process has one server, with the imports that were wanted when its first worker started.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imported))
    return context


def end_with_parent(sent: signal.Signals) -> None:
    """In the child: be sent a signal when the parent dies, however it does (Linux; elsewhere nothing is done)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, sent)


def begin_worker() -> None:
    """First call of a worker process: Ctrl-C is the parent's business, and without a parent there is nothing to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)
    if sys.platform.startswith("linux") and os.getppid() == 1:  # the parent died before the line above
        os._exit(1)
    started_by = multiprocessing.parent_process()
    if started_by is not None:  # not the fork server, which lives as long as a worker does
        threading.Thread(target=_end_after, args=(started_by,), daemon=True).start()


def _end_after(process: BaseProcess) -> None:
    process.join()
    os._exit(1)
