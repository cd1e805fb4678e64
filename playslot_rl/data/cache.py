"""Cache folders: made once, whole or absent, safe with several processes, outside every data set.

CACHE/frames/KEY   CACHE/slots/KEY      entries; what is in use is held by a lock in them
CACHE/remote/NAME-COMMIT                metadata of a data set on the Hub: small, neither listed nor limited
CACHE/frames/.KEY.part                  one that is being made, or that a kill has left: the next use goes on there

Room is made by what was used least recently, never by what a process uses.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import shutil
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.config.sizes import bytes_of, shown
from playslot_rl.errors import DataError, OutputError, PlaySlotError
from playslot_rl.storage.atomic import explain_write_errors, json_or_nothing, replace_dir
from playslot_rl.storage.locks import alone, last_use, locked, release_with, remove_unused, share

if TYPE_CHECKING:
    from playslot_rl.config import DataConfig

KINDS: Final = ("frames", "slots")
LEFT: Final = ".tmp-"
"""In the name of a folder that is being made or removed, or that a kill has left (`playslot_rl.storage.folders`)."""
ENTRY_NAME: Final = "meta.json"
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


CachePlace = str | Path | Cache  # a cache, or only its folder


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


@dataclass(frozen=True)
class Entry:
    """One entry of a cache.

    Attributes:
        data: folder of the data set it was made from, as it was named then; empty where an older version made it.
        in_use: whether a process has it open, or makes it.
        part: whether it is not finished: it is being made, or a kill has left it.
    """

    path: str
    kind: str
    data: str
    bytes: int
    used: float
    in_use: bool
    part: bool

    @property
    def name(self) -> str:
        """What `playslot cache clear` calls it."""
        folder = Path(self.path)
        return _key(folder) if self.part else folder.name

    def line(self) -> str:
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.used))
        state = "in use" if self.in_use else "unfinished" if self.part else "free"
        return f"{self.name}  {self.kind:6}  {shown(self.bytes):>8}  {when}  {state:10}  {self.data or '-'}"


def entries(cache: CachePlace = "") -> list[Entry]:
    """All entries, those first that were used longest ago."""
    found = []
    for kind in KINDS:
        for folder in (cache_folder(cache) / kind).glob("*"):
            part = folder.name.startswith(".") and (folder.name.endswith(".part") or LEFT in folder.name)
            if folder.is_dir() and (part or not folder.name.startswith(".")):
                with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                    found.append(_entry(folder, kind, part))
    return sorted(found, key=lambda entry: entry.used)


def _entry(folder: Path, kind: str, part: bool) -> Entry:
    used, files = last_use(folder), [path for path in folder.rglob("*") if path.is_file()]
    data = str(json_or_nothing(folder / ENTRY_NAME).get("name", ""))
    with _unmade(folder) if part else alone(folder) as free:
        # What is being made will fill its holes; what a kill has left will not.
        size = sum(path.stat().st_size if part and not free else _stored(path) for path in files)
        return Entry(str(folder), kind, data, size, used, not free, part)


def _key(part: Path) -> str:
    """Name of the entry that a folder was to become."""
    return part.name.removeprefix(".").removesuffix(".part").partition(LEFT)[0]


def _stored(path: Path) -> int:
    """Bytes on disk: an array that was being made has holes."""
    status = path.stat()
    return min(status.st_size, status.st_blocks * 512) if hasattr(status, "st_blocks") else status.st_size


MAKING: Final = "it is being made"


@contextlib.contextmanager
def _unmade(part: Path) -> Iterator[bool]:
    """Whether nobody makes the entry; inside the block nobody begins to."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(lock_file(part.with_name(_key(part))), busy=MAKING))
        except OutputError as error:
            if str(error) != MAKING:
                raise
            yield False
            return
        yield True


def remove(entry: Entry) -> bool:
    """Remove an entry that nobody uses; whether it is gone."""
    folder = Path(entry.path)
    if not entry.part:
        return remove_unused(folder)
    with _unmade(folder) as free:
        if free:
            shutil.rmtree(folder, ignore_errors=True)
        return free and not folder.exists()


@contextlib.contextmanager
def room(cache: CachePlace, needed: int, key: str) -> Iterator[None]:
    """Make room, and begin an entry in the block, by making its file as large as it will be: two processes do not both
    take the same room. Arguments and errors: see `make_room`."""
    with locked(cache_folder(cache) / ".room.lock") if settings(cache).limit is not None else contextlib.nullcontext():
        make_room(cache, needed, key)
        yield


def make_room(cache: CachePlace, needed: int, key: str) -> None:
    """Remove entries, the least recently used first, until `needed` more bytes fit below the cache's limit.

    What a killed process has left of the entry `key`, which is to be made, does not count.

    Raises:
        DataError: it does not fit beside what is in use; then nothing is removed.
    """
    limit = settings(cache).limit
    if limit is None:
        return
    there = [entry for entry in entries(cache) if entry.name != key]
    total, kept = sum(entry.bytes for entry in there), sum(entry.bytes for entry in there if entry.in_use)
    if kept + needed > limit:
        raise DataError(
            f"data.cache_limit={shown(limit)}: got {shown(needed)} to store beside {shown(kept)} in use, expected "
            "less: raise it, wait for the other processes, or read without a frame cache by data.stream=true"
        )
    for entry in there:
        if total + needed <= limit:
            return
        if not entry.in_use and remove(entry):
            total -= entry.bytes


@dataclass(frozen=True)
class Listing:
    """What `playslot cache list` says."""

    folder: str
    entries: Sequence[Entry]

    def to_json(self) -> str:
        rows = [{"name": entry.name, **asdict(entry)} for entry in self.entries]
        return json.dumps({"folder": self.folder, "entries": rows}, indent=2)

    def lines(self) -> list[str]:
        total = f"{self.folder}: {len(self.entries)} entries, {shown(sum(entry.bytes for entry in self.entries))}"
        return [*(entry.line() for entry in self.entries), total]


def listing(cache: Path | None = None) -> Listing:
    """What a cache holds; None means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`."""
    folder = cache_folder(cache or "")
    return Listing(str(folder), entries(folder))


@dataclass(frozen=True)
class Cleared:
    """What `playslot cache clear` says."""

    folder: str
    removed: Sequence[Entry]
    kept: Sequence[Entry]

    def to_json(self) -> str:
        names = {"removed": [entry.name for entry in self.removed], "in_use": [entry.name for entry in self.kept]}
        return json.dumps({"folder": self.folder, **names, "bytes": self._freed()}, indent=2)

    def lines(self) -> list[str]:
        lines = [f"{entry.name}: in use, left" for entry in self.kept]
        return [*lines, f"{self.folder}: {len(self.removed)} entries removed, {shown(self._freed())} free again"]

    def _freed(self) -> int:
        return sum(entry.bytes for entry in self.removed)


def clear(names: Sequence[str] = (), cache: Path | None = None) -> Cleared:
    """Remove entries that nobody uses: all of them, or those of some names (their beginnings will do).

    Raises:
        DataError: no entry of such a name.
    """
    folder = cache_folder(cache or "")
    there = entries(folder)
    for name in names:
        if not any(entry.name.startswith(name) for entry in there):
            raise DataError(f"{folder}: got no entry {name}, expected one of `playslot cache list`")
    chosen = [entry for entry in there if not names or entry.name.startswith(tuple(names))]
    removed = [entry for entry in chosen if remove(entry)]
    return Cleared(str(folder), removed, [entry for entry in chosen if entry not in removed])
