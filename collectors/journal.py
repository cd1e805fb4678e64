"""The journal: one file per finished episode, each whole or not there, beside the data set that is being made."""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.collectors.episodes import Episode
from playslot_rl.collectors.spec import CollectionSpec, difference
from playslot_rl.errors import OutputError
from playslot_rl.training.atomic import explain_write_errors, write_bytes, write_json

SPEC_NAME = "collection.json"
LOCK_NAME = "lock"
ARRAYS = ("frames", "states", "actions", "rewards", "success")


def journal_path(out: Path) -> Path:
    """Folder of the journal of the data set `out`."""
    return out.with_name(f"{out.name}.journal")


class Journal:
    """Finished episodes of one collection.

    Args:
        folder: made if needed.
        spec: what is collected.

    Raises:
        OutputError: the folder holds something else, or a collection with other settings, or cannot be written.
    """

    def __init__(self, folder: Path, spec: CollectionSpec) -> None:
        self.folder, self.spec = folder, spec
        with explain_write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        stored = folder / SPEC_NAME
        if stored.is_file():
            found = read_spec(stored)
            differs = difference(found, spec.to_dict())
            if differs:
                raise OutputError(
                    f"{folder} holds an unfinished collection with other settings ({differs}); "
                    "repeat them, choose another out=, or delete that folder"
                )
        elif any(p.name != LOCK_NAME and not p.name.startswith(".") for p in folder.iterdir()):
            raise OutputError(f"{folder}: got a folder of something else, expected our journal; choose another out=")
        else:
            write_json(stored, spec.to_dict())

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out.

        Raises:
            OutputError: another process is collecting into this folder.
        """
        with explain_write_errors(self.folder):
            handle = os.open(self.folder / LOCK_NAME, os.O_CREAT | os.O_RDWR)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise OutputError(
                    f"{self.folder}: got another process collecting into it, expected none; wait for it or choose out="
                ) from error
            yield
        finally:
            os.close(handle)

    def path(self, index: int) -> Path:
        """File of episode `index`."""
        return self.folder / f"episode_{index:06d}.npz"

    def add(self, episode: Episode) -> None:
        """Store an episode; when this returns it survives a kill and a power cut.

        Raises:
            OutputError: full disk.
        """
        arrays: dict[str, Any] = {name: getattr(episode, name) for name in ARRAYS}
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, numbers=np.array([episode.index, episode.seed, episode.redrawn], np.int64), **arrays
        )
        write_bytes(self.path(episode.index), buffer.getvalue())

    def read(self, index: int) -> Episode:
        """Load episode `index`.

        Raises:
            OutputError: its file is missing or damaged.
        """
        path = self.path(index)
        try:
            with np.load(path, allow_pickle=False) as file:
                numbers = [int(n) for n in file["numbers"]]
                return Episode(numbers[0], numbers[1], numbers[2], **{name: file[name] for name in ARRAYS})
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise OutputError(
                f"{path}: got a damaged file ({error}), expected an episode; delete it and run the same command again"
            ) from error

    def missing(self) -> list[int]:
        """Episodes that are not stored yet."""
        return [i for i in range(self.spec.episodes) if not self.path(i).is_file()]

    def remove(self) -> None:
        """Delete the journal."""
        shutil.rmtree(self.folder)


def read_spec(path: Path) -> dict[str, Any]:
    """Read a stored specification.

    Raises:
        OutputError: it is not JSON of ours.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: got {error}, expected JSON; delete the folder or choose another out=") from error
    if not isinstance(found, dict):
        raise OutputError(f"{path}: got {type(found).__name__}, expected a record; choose another out=")
    return found
