"""New folders that are either whole or not there: everything is written beside the final name, then renamed once."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

from playslot_rl.errors import OutputError
from playslot_rl.storage.atomic import explain_write_errors, lock, replace_dir, temporary_name, write_bytes


def require_free(out: Path, key: str = "out=") -> None:
    """Refuse to write over something; an empty folder is free.

    Args:
        out: the folder to make.
        key: how its user names it, for the message.

    Raises:
        OutputError: something is there.
    """
    if out.is_symlink() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise OutputError(
            f"{key}{out}: got something that is there already, expected none; choose another {key.strip()}"
        )


def require_outside(
    out: str | Path, reads: Iterable[str | Path] = (), key: str = "out=", kind: Literal["folder", "file"] = "folder"
) -> None:
    """Refuse to write into a data set: what lies in one is pushed with it. Symbolic links are followed.

    Args:
        out: file or folder to write.
        reads: data sets, or downloads, that are read: `out` may neither be one nor lie in one. It may not lie in any
            other LeRobot data set either.
        key: how its user names `out`, for the message.
        kind: what `out` is to be.

    Raises:
        OutputError: it does, or a file stands where one of its parents has to be.
    """
    place = Path(os.path.realpath(out))  # unlike Path.resolve, of links that go round in a circle too
    inside = [root for root in reads if place.is_relative_to(os.path.realpath(root))]
    inside += [parent for parent in place.parents if (parent / "meta" / "info.json").is_file()]
    if inside:
        wanted = f"a {kind} outside: a push would upload it"
        raise OutputError(f"{key}{out}: got a place inside the data set {inside[0]}, expected {wanted}")
    for parent in place.parents:
        if parent.exists() and not parent.is_dir():
            raise OutputError(f"{key}{out}: got the file {parent} in its path, expected folders: choose another")


@contextlib.contextmanager
def new_folder(final: Path, *, replace: bool = False, create: bool = True, key: str = "out=") -> Iterator[Path]:
    """Gives a temporary path beside `final`, renamed to it at the end and removed after an error.

    What processes that were killed in here have left is removed first. Another process that makes `final` at the same
    time is left alone: the first one to end has made it, the other one is refused.

    Args:
        final: the folder to make; its parents are made too.
        replace: whether something at `final` is replaced instead of refused.
        create: make the temporary folder; False where a library wants to, and the caller keeps other processes out.
        key: how the user names `final`, for the message.

    Raises:
        OutputError: `final` is not free, the disk is full, or it cannot be written.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with new_folder(Path(folder) / "made") as temporary:
        ...         _ = (temporary / "file").write_text("whole")
        ...     (Path(folder) / "made" / "file").read_text()
        'whole'
    """
    if not replace:
        require_free(final, key)
    temporary = temporary_name(final)
    with explain_write_errors(final):
        final.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(final.parent, glob.escape(final.name))
        if create:
            temporary.mkdir()
        with held(temporary) if create else contextlib.nullcontext():  # no other process takes it for a leftover
            try:
                yield temporary
                if not replace:
                    require_free(final, key)
                    if final.is_dir():
                        final.rmdir()  # empty
                replace_dir(temporary, final)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def held(folder: Path) -> Iterator[bool]:
    """Keep a folder to this process inside the block; gives whether it was free.

    Raises:
        OSError: it cannot be opened.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield lock(handle)
    finally:
        os.close(handle)


def by_name(folder: Path) -> Path:
    """A folder by its name, which `.` and `..` do not say: others go beside it under names made of it."""
    return folder.resolve() if folder.name in ("", "..") else folder


def remove_leftovers(folder: Path, pattern: str) -> None:
    """Remove what processes that were killed while they made what a pattern names in a folder have left."""
    for leftover in folder.glob(f".{pattern}.tmp-*"):
        with contextlib.suppress(OSError), held(leftover) as free:
            if free:
                shutil.rmtree(leftover, ignore_errors=True)


def copy_files(source: Path, target: Path) -> None:
    """Copy the files of a folder into another one, which appears whole and replaces what is there."""
    with new_folder(target, replace=True) as temporary:
        for file in sorted(source.iterdir()):
            write_bytes(temporary / file.name, file.read_bytes())
