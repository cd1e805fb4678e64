"""The journal: one file per finished episode, each whole or not there, beside the data set that is being made."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playslot_rl.collectors.encoding import encode, read
from playslot_rl.collectors.episodes import RecordedEpisode
from playslot_rl.collectors.spec import CollectionSpec, completed, difference
from playslot_rl.errors import OutputError
from playslot_rl.storage.atomic import explain_write_errors, write_bytes, write_json
from playslot_rl.storage.locks import locked

SPEC_NAME = "collection.json"
LOCK_NAME = "lock"


def journal_path(out: Path) -> Path:
    """Folder of the journal of the data set `out`."""
    return out.with_name(f"{out.name}.journal")


def episode_path(folder: Path, index: int) -> Path:
    """File of episode `index` in a journal's folder."""
    return folder / f"episode_{index:06d}.npz"


def store(folder: Path, episode: RecordedEpisode) -> None:
    """Write an episode's file into a journal's folder; when this returns it survives a kill and a power cut.

    Raises:
        OutputError: full disk.
    """
    write_bytes(episode_path(folder, episode.index), encode(episode))


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
            differs = difference(completed(found), spec.to_dict())
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
        busy = f"{self.folder}: got another process collecting into it, expected none; wait for it or choose out="
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked(self.folder / LOCK_NAME, busy))
            except OutputError:
                if self._is_there():
                    raise
            if not self._is_there():  # its owner finished, and removed what we have locked
                raise OutputError(
                    f"{self.folder}: got a journal that another process has just removed, expected ours; "
                    "run the same command again"
                )
            for half in self.folder.glob(".*.tmp-*"):  # of killed processes: the lock is ours, nobody is writing them
                half.unlink(missing_ok=True)
            yield

    def _is_there(self) -> bool:
        return (self.folder / SPEC_NAME).is_file()

    def path(self, index: int) -> Path:
        """File of episode `index`."""
        return episode_path(self.folder, index)

    def add(self, episode: RecordedEpisode) -> None:
        """Store an episode; when this returns it survives a kill and a power cut.

        Raises:
            OutputError: full disk.
        """
        store(self.folder, episode)

    def add_encoded(self, index: int, content: bytes) -> None:
        """Store an episode that was encoded elsewhere (see `add`)."""
        write_bytes(self.path(index), content)

    def read(self, index: int) -> RecordedEpisode:
        """Load episode `index`.

        Raises:
            OutputError: its file is missing or damaged.
        """
        return self.read_with_images(index)[0]

    def read_with_images(self, index: int, decode: bool = True) -> tuple[RecordedEpisode, list[bytes]]:
        """Load episode `index` and the PNGs of its frames; without `decode` its `frames` are left empty.

        Raises:
            OutputError: its file is missing or damaged, or holds another episode.
        """
        episode, images = read(self.path(index), decode)
        if episode.index != index:
            raise OutputError(
                f"{self.path(index)}: got episode {episode.index}, expected {index}; delete it and run the same "
                "command again"
            )
        return episode, images

    def missing(self) -> list[int]:
        """Episodes that are not stored yet."""
        there = {entry.name for entry in os.scandir(self.folder)}
        return [i for i in range(self.spec.episodes) if self.path(i).name not in there]

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
