"""Locks between processes: of a file, and of a folder, which any number of them read together and one alone removes.

The system drops the locks of a process that ends, however it ends; the files stay. A folder's lock is held by an open
file, so two uses within one process are two, too. Where the system (Windows) or the file system has no `flock` nobody
is kept out.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from playslot_rl.errors import OutputError
from playslot_rl.storage.atomic import explain_write_errors, is_open_at, lock, temporary_name, unlock

NAME: Final = "in_use.lock"
"""Of the file in the folder; its time says when the folder was last taken."""
POLL: Final = 0.05
"""Seconds between two looks at a lock that another process holds."""


@contextlib.contextmanager
def locked(path: Path, busy: str = "", patience: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file, which is made if needed; its folder must exist.

    Args:
        busy: one line for the OutputError where another process holds it; empty waits for that process instead.
        patience: seconds until that error; children of a killed process hold its locks until they notice.
    """
    until = time.monotonic() + patience if busy else math.inf
    while (handle := _taken(path)) is None:
        if time.monotonic() >= until:
            raise OutputError(busy)
        time.sleep(POLL)
    try:
        yield
    finally:
        unlock(handle)


def _taken(path: Path) -> int | None:
    """The file, open and this process's alone; None where another one has it, or it was removed meanwhile."""
    with explain_write_errors(path):
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if lock(handle) and is_open_at(handle, path):
            return handle
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return None


def share(folder: Path) -> int | None:
    """Take a folder into use; its last use is now. Gives an open file that holds it until it is closed
    (`release_with`), -1 where the folder cannot be locked (a read-only file system), or None where it is not there any
    more.
    """
    path = folder / NAME
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except FileNotFoundError:
        return None
    except OSError:
        return -1 if folder.is_dir() else None
    lock(handle, shared=True)
    if not is_open_at(handle, path):  # removed by the process that had it alone
        os.close(handle)
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return handle


def release_with(owner: Any, handle: int) -> None:
    """Hold what `share` returned as long as an object lives."""
    if handle >= 0:
        weakref.finalize(owner, os.close, handle)


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[bool]:
    """Whether nobody uses the folder; inside the block nobody begins to."""
    path = folder / NAME
    try:
        used = last_use(folder)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        os.utime(path, (used, used))  # looking is no use, also where the file is made now
    except OSError:
        yield False
        return
    try:
        yield lock(handle, without_locks=False)
    finally:
        os.close(handle)


def last_use(folder: Path) -> float:
    """Seconds since 1970."""
    path = folder / NAME
    return (path if path.is_file() else folder).stat().st_mtime


def remove_unused(folder: Path) -> bool:
    """Remove a folder that nobody uses; whether it is gone."""
    with alone(folder) as free:
        if not free:
            return not folder.is_dir()
        hidden = temporary_name(folder)
        folder.rename(hidden)
    shutil.rmtree(hidden, ignore_errors=True)
    return not hidden.exists()
