"""Processes that this one starts: none outlives it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

PR_SET_PDEATHSIG: Final = 1


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
