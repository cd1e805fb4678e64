"""Cache folders: made once, whole or absent, safe with several processes, outside every data set."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import explain_write_errors
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.locks import locked


def cache_folder(cache: str | Path = "") -> Path:
    """The cache: as given, else `$PLAYSLOT_CACHE`, else `~/.cache/playslot_rl`."""
    chosen = str(cache) or os.environ.get("PLAYSLOT_CACHE", "")
    return Path(chosen).expanduser() if chosen else Path.home() / ".cache" / "playslot_rl"


def build_once(folder: Path, build: Callable[[Path], None]) -> Path:
    """Return `folder`, made by `build(temporary)` if it does not exist.

    A lock lets one process build while others wait.

    Raises:
        OutputError: full disk; nothing is left behind.
    """
    if folder.is_dir():
        return folder
    with explain_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(folder.with_name(f".{folder.name}.lock")):
        if not folder.is_dir():
            with new_folder(folder) as temporary:
                build(temporary)
    return folder


def load_cached(folder: Path, name: str) -> npt.NDArray[Any]:
    """Memory-map an array of a cache folder, read-only.

    Raises:
        DataError: the file was damaged after it was made.
    """
    try:
        array: npt.NDArray[Any] = np.load(folder / name, mmap_mode="r")
    except (OSError, ValueError) as error:
        raise DataError(f"{folder / name} is damaged ({error}), expected a cached array: delete {folder}") from error
    return array


class ArrayWriter:
    """Writes an `.npy` file piece by piece along its first axis.

    Plain writes, because a full disk under a memory map is a bus error, not an exception.
    """

    def __init__(self, path: Path, shape: Sequence[int], dtype: npt.DTypeLike) -> None:
        self.path, self.shape, self.dtype = path, tuple(shape), np.dtype(dtype)
        self.rows = 0
        self._file: IO[bytes] = path.open("wb")
        header = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False, "shape": self.shape}
        np.lib.format.write_array_header_1_0(self._file, header)
        self._begin = self._file.tell()

    def write(self, rows: npt.NDArray[np.generic], first: int | None = None) -> None:
        """Write rows (n, *shape[1:]) from row `first` on; None goes on where the last ones ended."""
        if rows.shape[1:] != self.shape[1:]:
            raise ValueError(f"{self.path}: got rows of shape {rows.shape[1:]}, expected {self.shape[1:]}")
        if first is not None:
            self._file.seek(self._begin + first * int(np.prod(self.shape[1:])) * self.dtype.itemsize)
        self._file.write(np.ascontiguousarray(rows, self.dtype).data)
        self.rows += len(rows)

    def close(self, *, whole: bool = True) -> None:
        """Finish; all rows must have been written, unless it is not `whole`: the others are zeros."""
        if not whole:
            self._file.truncate(self._begin + int(np.prod(self.shape)) * self.dtype.itemsize)
        self._file.close()
        if whole and self.rows != self.shape[0]:
            raise ValueError(f"{self.path}: got {self.rows} rows, expected {self.shape[0]}")
