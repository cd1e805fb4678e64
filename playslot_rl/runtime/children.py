"""Processes that this one starts: none outlives it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.context import ForkServerContext
from typing import Final

PR_SET_PDEATHSIG: Final = 1
IMPORTED: Final = ("torchrl.envs",)
"""What every worker needs and takes seconds to import; with it torch and tensordict."""


def worker_context(imported: Sequence[str] = IMPORTED) -> ForkServerContext:
    """How workers start: forked from one server, which has the imports, and no thread, GL context or GPU.

    The first worker starts as quickly as a fresh process, each further one in tens of milliseconds, and all of them
    share the memory of the imports. The server ends with this process, and its workers with it (`begin_worker`). A
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
