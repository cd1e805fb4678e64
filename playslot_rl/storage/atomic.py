"""Files and folders that are either whole or not there: temporary name in the same folder, fsync, rename.

A process killed at any moment leaves the old content or the new, never a half.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from playslot_rl.errors import CheckpointError, OutputError

_REASONS = {
    errno.ENOSPC: ("the disk is full", "free some space or choose another folder; the same command carries on"),
    errno.EDQUOT: (
        "the disk quota is used up",
        "free some space or choose another folder; the same command carries on",
    ),
    errno.EROFS: ("the file system is read-only", "choose another folder"),
    errno.EACCES: ("permission denied", "choose a folder you can write"),
    errno.EPERM: ("permission denied", "choose a folder you can write"),
    errno.ENAMETOOLONG: ("a name is too long", "choose a shorter one"),
    errno.ELOOP: ("its symbolic links go round in a circle", "choose another folder"),
    errno.ENOTDIR: ("a file stands where a folder is needed", "choose another folder"),
    errno.EEXIST: ("a file stands where a folder is needed", "choose another folder"),
    errno.ENOTEMPTY: ("another process has just made it", "use that one, or choose another folder"),
}


@contextlib.contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Turn a write below `path` that fails for a full disk or a closed folder into an OutputError of one line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, OutputError) or (known := write_error(path, error)) is None:
            raise
        raise known from error


def write_error(path: Path, error: BaseException) -> OutputError | None:
    """What kept from writing below `path`, in one line; None where it is another error."""
    if not isinstance(error, OSError) or error.errno not in _REASONS:
        return None
    reason, cure = _REASONS[error.errno]
    return OutputError(f"cannot write {path}: {reason}, expected a writable folder with free space; {cure}")


def temporary_name(path: Path) -> Path:
    """A fresh hidden name beside `path`, hence on the same file system."""
    return path.with_name(f".{path.name}.tmp-{uuid.uuid4().hex[:12]}")


def fsync_folder(folder: Path) -> None:
    """Make renames inside `folder` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def lock(handle: int, *, shared: bool = False, without_locks: bool = True) -> bool:
    """Whether an open file or folder now is this process's until it closes it or ends: alone, or shared with others,
    for which it waits for one that has it alone. On a file system that has no locks, where nobody knows,
    `without_locks`.
    """
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH if shared else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return without_locks
    return True


def unlock(handle: int) -> None:
    """Give a lock back and close its file; closing alone leaves it to processes that were forked meanwhile."""
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def is_open_at(handle: int, path: Path) -> bool:
    """Whether an open file or folder still has that name."""
    try:
        return path.stat().st_ino == os.fstat(handle).st_ino
    except FileNotFoundError:
        return False


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; its folder is made if needed. What a process that was killed in here has left is written
    over by the next one. After an OutputError `path` has its old content.
    """
    with explain_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary, file = _free_temporary(path)
        with file:
            try:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
                temporary.replace(path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
        fsync_folder(path.parent)


def _free_temporary(path: Path) -> tuple[Path, BinaryIO]:
    """A hidden file beside `path`, empty, open and nobody else's: the first that no process writes."""
    for number in itertools.count():
        temporary = path.with_name(f".{path.name}.tmp-{number}")
        file = temporary.open("ab")
        if lock(file.fileno()) and is_open_at(file.fileno(), temporary):
            file.truncate(0)
            return temporary, file
        file.close()
    raise AssertionError


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically (see `write_bytes`)."""
    write_bytes(path, text.encode())


def write_json(path: Path, obj: Any) -> None:
    """Write JSON atomically (see `write_bytes`). Raises ValueError: a number is not finite, which JSON cannot hold."""
    write_text(path, json.dumps(obj, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, cure: str = "train that stage again") -> dict[str, Any]:
    """Read a JSON object. Raises CheckpointError: it is missing or damaged; ends with the `cure`."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is damaged ({error}), expected a JSON object: {cure}") from error
    if not isinstance(values, dict):
        raise CheckpointError(f"{path} is damaged ({type(values).__name__}), expected a JSON object: {cure}")
    return values


def json_or_nothing(path: Path) -> dict[str, Any]:
    """A JSON object; empty where the file is missing or damaged."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def replace_dir(tmp: Path, final: Path) -> None:
    """Rename the finished folder `tmp` to `final`, after an fsync of everything in it.

    Where `final` exists it is set aside first and removed afterwards. That is two renames: a kill between them leaves
    no `final`, but both contents on disk; callers can make `final` again.
    """
    with explain_write_errors(final):
        for folder, _, files in os.walk(tmp):
            for name in files:
                with (Path(folder) / name).open("rb") as file:
                    os.fsync(file.fileno())
            fsync_folder(Path(folder))
        old: Path | None = None
        if final.exists():
            old = temporary_name(final)
            final.rename(old)
        tmp.rename(final)
        fsync_folder(final.parent)
        if old is not None:
            shutil.rmtree(old)
