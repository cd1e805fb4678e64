"""Cache folders: made once, whole or absent, safe with several processes, outside every data set.

CACHE/frames/KEY   CACHE/slots/KEY      entries; what is in use is held by a lock in them
CACHE/remote/NAME-COMMIT                metadata of a data set on the Hub: small, neither listed nor limited
CACHE/frames/.KEY.part                  one that is being made, or that a kill has left: the next use goes on there
"""

from __future__ import annotations

import mmap
import os
import shutil
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config.sizes import bytes_of
from playslot_rl.errors import DataError, PlaySlotError
from playslot_rl.storage.atomic import explain_write_errors, replace_dir
from playslot_rl.storage.locks import locked
from playslot_rl.storage.sharing_locks import release_with, share

if TYPE_CHECKING:
    from playslot_rl.config import DataConfig

RELEASE_EVERY: Final = 2**28  # bytes that are read from memory maps before their pages are given back


@dataclass(frozen=True)
class Cache:
    """Where caches are (empty: `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`), how many bytes they may have together, and
    how many processes decode (0: one for each core, 1: none but this one)."""

    folder: str | Path = ""
    limit: int | None = None
    workers: int = 1

    @staticmethod
    def of(config: DataConfig) -> Cache:
        """As `data.cache`, `.cache_limit` and `.workers` say."""
        return Cache(config.cache, bytes_of(config.cache_limit), config.workers)


CachePlace = str | Path | Cache  # A cache, or only its folder


def cache_folder(cache: CachePlace = "") -> Path:
    """The cache: as given, else `$PLAYSLOT_CACHE`, else `~/.cache/playslot_rl`."""
    chosen = str(cache.folder if isinstance(cache, Cache) else cache) or os.environ.get("PLAYSLOT_CACHE", "")
    return Path(chosen).expanduser() if chosen else Path.home() / ".cache" / "playslot_rl"


def settings(cache: CachePlace) -> Cache:
    return cache if isinstance(cache, Cache) else Cache(cache)


def build_once(folder: Path, build: Callable[[Path], None]) -> Path:
    """Return `folder`, made by `build(part)` if it does not exist; a lock lets one process build while others wait.

    A build that was killed is gone on with: `build` finds in its folder what it has made.

    Raises:
        OutputError: full disk; nothing is left behind, as after every other error.
    """
    if folder.is_dir():
        return folder
    with explain_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(lock_file(folder)):
        if not folder.is_dir():
            part = part_folder(folder)
            part.mkdir(exist_ok=True)
            try:
                build(part)
                replace_dir(part, folder)
            except Exception as error:  # not a kill or Ctrl-C
                if type(error) is not PlaySlotError:  # a worker of ours was killed
                    shutil.rmtree(part, ignore_errors=True)
                raise
    return folder


def part_folder(folder: Path) -> Path:
    """Where an entry is made."""
    return folder.with_name(f".{folder.name}.part")


def lock_file(folder: Path) -> Path:
    """Held by the process that makes an entry."""
    return folder.with_name(f".{folder.name}.lock")


def load_cached(folder: Path, name: str, make: Callable[[], object] | None = None) -> npt.NDArray[Any]:
    """Memory-map an array of a cache folder, read-only. The folder is in use as long as the array, or a view of it.

    `make` makes the entry where it is not there (any more: another process may make room at any time).

    Raises:
        DataError: the file was damaged after it was made.
    """
    while (handle := share(folder)) is None:
        if make is None:
            raise DataError(f"{folder}: got no such folder, expected a cached array: run the same command again")
        make()
    try:
        array: npt.NDArray[Any] = np.load(folder / name, mmap_mode="r")
    except (OSError, ValueError) as error:
        if handle >= 0:
            os.close(handle)
        raise DataError(f"{folder / name} is damaged ({error}), expected a cached array: delete {folder}") from error
    mapped = getattr(array, "_mmap", array)
    release_with(mapped, handle)
    _MAPPED.add(mapped)
    return array


_MAPPED: weakref.WeakSet[Any] = weakref.WeakSet()  # maps of this process
_read = [0]


def note_read(count: int) -> None:
    """Say that so many bytes of memory maps were read: now and then their pages are given back.

    The system counts every page that was ever touched as this process's memory, although it may take them back at any
    time. They stay in the system's own cache.
    """
    _read[0] += count
    if _read[0] < RELEASE_EVERY or not hasattr(mmap, "MADV_DONTNEED"):
        return
    _read[0] = 0
    for mapped in list(_MAPPED):
        if isinstance(mapped, mmap.mmap) and not mapped.closed:
            mapped.madvise(mmap.MADV_DONTNEED)


class ArrayWriter:
    """Writes an `.npy` file piece by piece along its first axis.

    Plain writes, because a full disk under a memory map is a bus error, not an exception. The file has its length from
    the beginning, all holes; one that has begun is gone on with.
    """

    def __init__(self, path: Path, shape: Sequence[int], dtype: npt.DTypeLike, begun: bool = False) -> None:
        self.path, self.shape, self.dtype = path, tuple(shape), np.dtype(dtype)
        self._file: IO[bytes] = path.open("r+b" if begun else "wb")
        header = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False, "shape": self.shape}
        np.lib.format.write_array_header_1_0(self._file, header)
        self._begin = self._file.tell()
        self._file.truncate(self._begin + int(np.prod(self.shape)) * self.dtype.itemsize)

    def write(self, rows: npt.NDArray[np.generic], first: int = 0) -> None:
        """Write rows (n, *shape[1:]) from row `first` on."""
        if rows.shape[1:] != self.shape[1:]:
            raise ValueError(f"{self.path}: got rows of shape {rows.shape[1:]}, expected {self.shape[1:]}")
        self._file.seek(self._begin + first * int(np.prod(self.shape[1:])) * self.dtype.itemsize)
        self._file.write(np.ascontiguousarray(rows, self.dtype).data)

    def sync(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
