"""Which files of a LeRobot data set travel, how a file is compared with what the Hub says about it, and the small file
that a push puts beside the data: what whoever pulls it has to find again.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from playslot_rl import __version__
from playslot_rl.data.metadata import json_content
from playslot_rl.data.places import inside, is_plain, is_plain_path
from playslot_rl.errors import HubError

if TYPE_CHECKING:
    from huggingface_hub import RepoFile


CARD_NAME = "README.md"
REMOTE_RECORD = "meta/playslot_hub.json"
"""Written by a push: fingerprint and counts, for whoever pulls."""
LOCAL_RECORD = "meta/playslot_pull.json"
"""Written by a pull: where the folder came from. Never uploaded."""

_SUFFIXES = {"data": {".parquet"}, "meta": {".parquet", ".json", ".jsonl"}, "videos": {".mp4"}}
_GENERATED = {REMOTE_RECORD, LOCAL_RECORD}


def is_data(path: str) -> bool:
    """Whether a path (from the root, with slashes) is part of a data set: rows, videos or metadata, nothing hidden."""
    parts = PurePosixPath(path).parts
    if len(parts) < 2 or not is_plain_path(path) or any(part.startswith(".") for part in parts):
        return False
    return PurePosixPath(path).suffix in _SUFFIXES.get(parts[0], set())


def _is_licence(path: str) -> bool:
    return path.startswith("LICENSE") and is_plain(path)


def is_pulled(path: str) -> bool:
    """Whether a pull fetches this path: the data set, its card and its licence, no more."""
    return (is_data(path) and path != LOCAL_RECORD) or path == CARD_NAME or _is_licence(path)


def require_plain(paths: Iterable[str], name: str) -> None:
    """Refuse, by a HubError, files of a repository that would not be written where their names say, such as
    `meta/a\\..\\b.json`, which leads elsewhere on another system.
    """
    odd = [path for path in paths if not is_plain_path(path)]
    if odd:
        raise HubError(
            f"{name}: got a file named {odd[0][:80]!r}, expected a path of plain names below the folder: ask its owner "
            "to remove it"
        )


def local_files(root: Path) -> tuple[list[str], list[str]]:
    """Paths of the files below `root` that a push uploads, and of those that it leaves, in order: caches, journals,
    lock and temporary files, images/ that LeRobot did not clean up, hidden files. Neither has links out of the folder,
    nor the card and the records, which a push makes.
    """
    files = [file for file in root.rglob("*") if file.is_file()]
    paths = sorted(file.relative_to(root).as_posix() for file in files if inside(root, file))
    others = [path for path in paths if path != CARD_NAME and path not in _GENERATED]
    sent = [path for path in others if is_data(path) or _is_licence(path)]
    return sent, [path for path in others if path not in set(sent)]


def same_content(item: Path | bytes, remote: RepoFile) -> bool:
    """Whether a file, or bytes, has the size and the hash that the Hub names: the SHA-256 of the content in large-file
    storage, and git's object id of other files.
    """
    if isinstance(item, Path) and not item.is_file():
        return False
    if size_of(item) != remote.size:
        return False
    digest = hashlib.sha256() if remote.lfs else hashlib.sha1(b"blob %d\0" % remote.size, usedforsecurity=False)
    with io.BytesIO(item) if isinstance(item, bytes) else item.open("rb") as stream:
        hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest() == (remote.lfs.sha256 if remote.lfs else remote.blob_id)


def size_of(item: Path | bytes) -> int:
    return len(item) if isinstance(item, bytes) else item.stat().st_size


SCHEME = 1
"""Version of `datasets/fingerprint.py`, to be raised when that changes: those of another version are not compared."""


@dataclass(frozen=True)
class HubRecord:
    """What was pushed, with the fingerprint that `playslot dataset verify` prints; equal to another record of the same
    content.
    """

    fingerprint: str
    episodes: int
    frames: int
    scheme: int = field(compare=False)
    playslot_rl: str = field(compare=False)

    @classmethod
    def of(cls, fingerprint: str, episodes: int, frames: int) -> HubRecord:
        return cls(fingerprint, episodes, frames, SCHEME, __version__)


def read_record(root: Path) -> HubRecord | None:
    """The record of a pulled data set; None where it was pushed by something else. A HubError where it is damaged."""
    path = root / REMOTE_RECORD
    if not path.is_file():
        return None
    try:
        return HubRecord(**json_content(path))
    except (ValueError, TypeError) as error:
        raise HubError(
            f"{REMOTE_RECORD}: got a damaged record ({type(error).__name__}), expected what `playslot dataset push` "
            "writes: ask its owner to push again"
        ) from error
