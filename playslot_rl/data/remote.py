"""Data sets that are read where they lie: `data.root=hf://datasets/USER/NAME[@REVISION]`, with `data.stream=true`.

The metadata are fetched, once for each commit; frames are read by ranges of the files that hold them, as they are
wanted, and never written. What changes on the Hub after a command has begun is another commit, and not seen.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from playslot_rl import keys
from playslot_rl.data.cache import build_once
from playslot_rl.data.contents import Contents, read_metadata
from playslot_rl.data.hub_faults import Asked, one_line
from playslot_rl.data.metadata import DATA_PATH, FORMAT_TAG, INFO_NAME
from playslot_rl.data.places import Problems, filled, is_plain_path
from playslot_rl.data.tables import MOST_ROWS, Array, Episode, read_columns
from playslot_rl.errors import DataError
from playslot_rl.runtime.processes import here
from playslot_rl.storage.secrets import checked_token, mask

BUFFER: Final = 1 << 20  # bytes that are asked of the client at once; it reads ahead by more
_LOOK = "pull it and run `playslot dataset verify`"
_ADDRESS = re.compile(r"hf://datasets/([\w.-]+/[\w.-]+?)(?:@([^@\s]+))?/?")


@dataclass(frozen=True)
class Remote:
    """The files of one commit of a data set on the Hub.

    Attributes:
        place: of the commit, as `huggingface_hub.HfFileSystem` names it.
        root: folder of the metadata on this machine; the paths of all files begin with it.
        hashes: of every file of the data set, by its path below the root.
    """

    address: str
    place: str
    root: Path
    hashes: Mapping[str, str] = field(repr=False)
    token: str | None = field(repr=False)

    def open(self, path: Path) -> io.BufferedReader:
        """A file, to be read by ranges of a few megabytes; each reader has its own. A DataError where the Hub does not
        answer."""
        from huggingface_hub import HfFileSystem

        name = f"{self.place}/{path.relative_to(self.root).as_posix()}"
        with self.asking():
            try:
                file = HfFileSystem(token=self.token or False).open(name, "rb")
            except FileNotFoundError as error:
                raise DataError(f"{self.address}: got no file {path.name}, expected it there: {_LOOK}") from error
        return io.BufferedReader(_Ranges(self, file), BUFFER)

    def asking(self) -> contextlib.AbstractContextManager[None]:
        return _asking(self.address, self.token, self.root)

    def holds(self, path: Path) -> bool:
        return path.relative_to(self.root).as_posix() in self.hashes

    def fingerprint(self, camera: str) -> str:
        """Hash of the names and hashes of what `Contents.file_hash` reads: 16 hex digits. It is another one."""
        videos = f"videos/{camera}/"
        told = (INFO_NAME, "meta/episodes/", "data/", videos)
        wanted = sorted((path, value) for path, value in self.hashes.items() if path.startswith(told))
        return hashlib.sha256(json.dumps(wanted).encode()).hexdigest()[:16]


class _Ranges(io.RawIOBase):
    """A file of the Hub whose errors are one line."""

    def __init__(self, remote: Remote, file: Any) -> None:
        self._remote, self._file = remote, file

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._file.seek(offset, whence))

    def tell(self) -> int:
        return int(self._file.tell())

    def readinto(self, buffer: Any) -> int:
        with self._remote.asking():
            piece = self._file.read(len(buffer))
        buffer[: len(piece)] = piece
        return len(piece)

    def close(self) -> None:
        self._file.close()
        super().close()


def _asking(address: str, token: str | None, root: Path, revision: str = "") -> contextlib.AbstractContextManager[None]:
    """A block that talks to the Hub: its errors are one line. The client has tried again by then."""
    from huggingface_hub import constants

    endpoint = mask(constants.ENDPOINT, token)
    asked = Asked(address, "data set", endpoint, root, revision, writing=False, has_token=token is not None)
    return one_line(asked, token, DataError)


def open_remote(address: str, cache: Path) -> Contents:
    """The metadata of a data set on the Hub, and where its frames are.

    Where frames are pictures they lie among the rows, and the rows' other columns (`action`, `next.success`, `seed`)
    are not read, since that would read everything; of a set of videos they are.

    Args:
        address: `hf://datasets/USER/NAME[@REVISION]`; without a revision the tag that LeRobot loads, else main.

    Raises:
        DataError: no such address, data set or revision; no answer; another format version, damaged metadata.
        OutputError: full disk.
    """
    remote = _commit_of(address, cache)
    problems = Problems()
    info, episodes, tasks = read_metadata(remote.root, problems, statistics=False)
    rows = _rows_of_files(remote, info, episodes)
    index = np.repeat([episode.index for episode in episodes], [episode.length for episode in episodes])
    columns: dict[str, Array] = {"episode_index": index}
    if not any(feature["dtype"] == "image" for feature in info["features"].values()):
        columns |= read_columns(list(rows), info, problems, remote.open)[2]
    elif keys.FEATURE_ACTION in info["features"] and here().first:
        print(f"note: {address}: its frames lie among its rows, whose actions are therefore not read", flush=True)
    if problems.errors or not episodes or len(columns["episode_index"]) != len(index):
        said = problems.errors[0] if problems.errors else f"{len(episodes)} episodes and other rows"
        raise DataError(f"{address}: {said}: {_LOOK}")
    return Contents(remote.root, info, episodes, tasks, list(rows), list(rows.values()), columns, remote)


def _commit_of(address: str, cache: Path) -> Remote:
    """Which commit an address means, with its metadata on this machine."""
    from huggingface_hub import HfApi, RepoFile, errors, get_token

    matched = _ADDRESS.fullmatch(address)
    if matched is None:
        raise DataError(
            f"{address}: got no data set's address, expected hf://datasets/USER/NAME, or with @REVISION after it"
        )
    name, revision = matched[1], matched[2]
    token = checked_token(get_token())
    api = HfApi(token=token or False, library_name="playslot_rl")
    with _asking(address, token, cache, revision or ""):
        try:
            info = api.dataset_info(name, revision=revision or FORMAT_TAG)
        except errors.RevisionNotFoundError:
            if revision:
                raise
            info = api.dataset_info(name)
        commit = str(info.sha)
        listed = api.list_repo_tree(name, repo_type="dataset", revision=commit, recursive=True)
        files = {entry.path: entry for entry in listed if isinstance(entry, RepoFile)}
    if INFO_NAME not in files:
        raise DataError(f"{address}: got no {INFO_NAME}, expected a LeRobot v3.0 data set: check the name")
    hashes = {path: file.lfs.sha256 if file.lfs else file.blob_id for path, file in files.items()}

    def fetch(folder: Path) -> None:
        wanted = [glob.escape(path) for path in files if path.startswith("meta/") and is_plain_path(path)]
        with _asking(address, token, cache):
            api.snapshot_download(name, repo_type="dataset", revision=commit, local_dir=folder, allow_patterns=wanted)

    root = build_once(cache / "remote" / f"{name.replace('/', '--')}-{commit[:16]}", fetch)
    return Remote(address, f"datasets/{name}@{commit}", root, hashes, token)


def _rows_of_files(remote: Remote, info: Mapping[str, Any], episodes: Sequence[Episode]) -> dict[Path, int]:
    """How many rows each data file has, in order, as the episodes' metadata tell it."""
    template, found, row = info.get("data_path") or DATA_PATH, dict[Path, int](), 0
    for episode in episodes:
        place = filled(template, episode.row.get("data/chunk_index"), episode.row.get("data/file_index"))
        begin = episode.row.get("dataset_from_index")
        if place is None or row + episode.length > MOST_ROWS:
            raise DataError(
                f"{remote.address}: got no file or too many rows of episode {episode.index}, expected its place in "
                f"data/: {_LOOK}"
            )
        path = remote.root / place
        if begin != row or path < next(reversed(found), path) or not remote.holds(path):
            raise DataError(
                f"{remote.address}: got episode {episode.index} from row {begin} of "
                f"{path.relative_to(remote.root)}, expected row {row} of a file that is there: {_LOOK}"
            )
        found[path] = found.get(path, 0) + episode.length
        row += episode.length
    return found
