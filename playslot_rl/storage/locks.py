"""Locks between processes. The system drops the lock of a process that ends, however it ends; the file stays."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from playslot_rl.errors import OutputError
from playslot_rl.storage.atomic import explain_write_errors


@contextlib.contextmanager
def locked(path: Path, busy: str = "", patience: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file, which is made if needed; its folder must exist.

    Args:
        busy: one line for the OutputError where another process holds it; empty waits for that process instead.
        patience: seconds until that error; children of a killed process hold its locks until they notice.
    """
    lock = FileLock(path, timeout=patience if busy else -1)
    try:
        with explain_write_errors(path):
            lock.acquire()
    except Timeout:
        raise OutputError(busy) from None
    try:
        yield
    finally:
        lock.release()
