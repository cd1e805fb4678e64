"""Files and folders that are either whole or not there: temporary name in the same folder, fsync, rename.

A process killed at any moment leaves the old content or the new, never a half.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playslot_rl.errors import OutputError

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
}


@contextlib.contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """Turn a failed write below `path` into one line.

    Raises:
        OutputError: the disk is full, or the folder cannot be written.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, OutputError) or error.errno not in _REASONS:
            raise
        reason, cure = _REASONS[error.errno]
        raise OutputError(
            f"cannot write {path}: {reason}, expected a writable folder with free space; {cure}"
        ) from error


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


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; its folder is made if needed.

    Raises:
        OutputError: full disk or a folder that cannot be written; `path` keeps its old content.
    """
    with explain_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(path)
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        fsync_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically (see `write_bytes`)."""
    write_bytes(path, text.encode())


def write_json(path: Path, obj: Any) -> None:
    """Write JSON atomically (see `write_bytes`).

    Raises:
        ValueError: a number is not finite, which JSON cannot hold.
    """
    write_text(path, json.dumps(obj, indent=2, allow_nan=False) + "\n")


def replace_dir(tmp: Path, final: Path) -> None:
    """Rename the finished folder `tmp` to `final`, after an fsync of everything in it.

    Where `final` exists it is set aside first and removed afterwards. That is two renames: a kill between them leaves
    no `final`, but both contents on disk; callers can make `final` again.

    Raises:
        OutputError: full disk or a folder that cannot be written.
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
