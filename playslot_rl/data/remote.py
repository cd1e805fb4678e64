"""Data sets that are read where they lie: `data.root=hf://datasets/USER/NAME[@REVISION]`, with `data.stream=true`; and
what goes wrong at the Hub: one line that says what to do, and no token in anything that is printed, logged or raised.

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
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from playslot_rl import keys
from playslot_rl.data.agreement import say_once
from playslot_rl.data.cache import build_once
from playslot_rl.data.contents import Contents, read_metadata
from playslot_rl.data.metadata import DATA_PATH, FORMAT_TAG, INFO_NAME
from playslot_rl.data.places import SHOWN, Problems, filled, is_plain_path
from playslot_rl.data.tables import MISSING, MOST_ROWS, Array, Episode, read_columns
from playslot_rl.errors import DEBUG, DataError, HubError, PlaySlotError
from playslot_rl.runtime.processes import here
from playslot_rl.storage.atomic import write_error
from playslot_rl.storage.secrets import checked_token, mask, masked_logs

LOG_IN = "run `hf auth login` once, or set HF_TOKEN"
AGAIN = "run the same command again"
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

    def fingerprint(self, camera: str, videos: Collection[Path]) -> str:
        """Hash of the names and hashes of what `Contents.file_hash` reads, `videos` of the camera wherever they lie: 16
        hex digits. It is another one."""
        told = (INFO_NAME, "meta/episodes/", "data/", f"videos/{camera}/")
        named = {path.relative_to(self.root).as_posix() for path in videos}
        wanted = sorted((p, value) for p, value in self.hashes.items() if p.startswith(told) or p in named)
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
    for line in problems.warnings_of(MISSING)[:SHOWN]:
        say_once(f"note: {line.replace(str(remote.root), address)}")
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


@dataclass(frozen=True)
class Asked:
    """What is asked of the Hub, as messages speak of it: `user/name`, or an address as it was typed; `data set` or
    `model`; the Hub's address; a local folder; the revision, if one was given; whether it is a push; whether a token is
    sent."""

    name: str
    what: str
    endpoint: str
    root: Path
    revision: str
    writing: bool
    has_token: bool


@contextlib.contextmanager
def one_line(asked: Asked, token: str | None, kind: type[PlaySlotError] = HubError) -> Iterator[None]:
    """Say what goes wrong inside in one line without the token; the error goes along as a note that is masked, too.

    Raises:
        PlaySlotError: of the `kind`, for an error of the Hub or its client; another one from inside, without the token.
    """
    try:
        with masked_logs(token):
            yield
        return
    except Exception as error:  # noqa: BLE001 - nothing that may hold a token goes on as it is
        known = translate(error, asked, kind)
        failure = type(known)(mask(str(known), token))
        failure.add_note(mask("".join(traceback.format_exception(error)), token))
    # A server may repeat the token it was sent, and the client's errors hold its answer: they do not go along.
    try:
        raise failure
    finally:
        failure.__context__ = None


def translate(error: BaseException, asked: Asked, kind: type[PlaySlotError] = HubError) -> PlaySlotError:
    """One line about an error of the Hub's client.

    The error itself is looked at first, then what caused it: uploads and downloads wrap the errors of their threads.
    """
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, PlaySlotError):
            return link
        said = _said(link, asked)
        if said is not None:
            return kind(said)
        unwritten = write_error(asked.root, link)
        if unwritten is not None:
            return unwritten
        link = link.__cause__ or link.__context__
    doing = "push" if asked.writing else "pull"
    return kind(
        f"{asked.name}: got {type(error).__name__}: {' '.join(str(error).split())} (unexpected; {DEBUG}=1 shows "
        f"where), expected the {doing} to go on"
    )


def _said(error: BaseException, asked: Asked) -> str | None:
    """What an error means; None if it is none of the client's."""
    import httpx
    from huggingface_hub import errors

    match error:
        case errors.OfflineModeIsEnabled():
            said = f"offline mode (HF_HUB_OFFLINE is set), expected access to the Hub: unset HF_HUB_OFFLINE and {AGAIN}"
        case errors.LocalTokenNotFoundError():
            said = f"no token, expected one with write access to push: {LOG_IN}"
        case errors.HfHubHTTPError():
            said = _answered(error, asked)
        case errors.HFValidationError() | errors.HfUriError():
            return (
                f"got the {asked.what} name {asked.name!r}, expected user/name of letters, digits, '-', '_' and '.': "
                f"your name on the Hub, a slash, and a name for the {asked.what}"
            )
        case httpx.UnsupportedProtocol() | httpx.InvalidURL():
            return f"got HF_ENDPOINT={asked.endpoint}, expected the address of a Hub: unset HF_ENDPOINT or mend it"
        case httpx.TransportError() | ConnectionError() | TimeoutError():
            said = (
                f"no connection to {asked.endpoint} ({type(error).__name__}), expected the network: check it and "
                f"{AGAIN}, it carries on"
            )
        case _ if "xet" in f"{type(error).__module__}.{type(error).__name__}".lower():
            said = (
                f"a failed transfer ({error}), expected the files to be moved: {AGAIN}, with HF_HUB_DISABLE_XET=1 if "
                "it fails again"
            )
        case _:
            return None
    return f"{asked.name}: got {said}"


def _answered(error: BaseException, asked: Asked) -> str:
    """What an answer of the Hub with an error status means."""
    from huggingface_hub import errors

    status = int(error.response.status_code)  # type: ignore[attr-defined]
    if isinstance(error, errors.RevisionNotFoundError):
        return (
            f"no revision {asked.revision or 'main'!r}, expected a branch, a tag or a commit: see its page on the Hub, "
            "or leave the revision out"
        )
    if isinstance(error, errors.GatedRepoError):
        return f"a gated {asked.what}, expected access to it: ask for access on its page, then {LOG_IN}"
    if status == 401 and asked.has_token and not isinstance(error, errors.RepositoryNotFoundError):
        return (
            "401, a bad token (invalid or expired), expected a valid one: make a new one in the Hub's "
            f"settings/tokens, then {LOG_IN}"
        )
    if status in (401, 404):
        # 401 also stands for a repository that is not there, for those who sent no token.
        who = "your token" if asked.has_token else "you: no token was sent"
        private = "" if asked.has_token else f"; if it is private, {LOG_IN}"
        return (
            f"no such {asked.what} on {asked.endpoint}, or one hidden from {who}; expected user/name of a "
            f"{asked.what}: check the name{private}"
        )
    if status == 403:
        return (
            f"403, the token may not {'write to' if asked.writing else 'read'} it; expected one with that right: check "
            "the owner's name, and the token's rights in the Hub's settings/tokens"
        )
    if status == 412:
        return f"another push in between, expected to be the only one: {AGAIN}"
    if status == 429:
        return f"429, too many requests, expected fewer: {AGAIN} in some minutes"
    if status >= 500:
        return (
            f"{status}, an error of the Hub's own, also after retries; expected an answer: {AGAIN} later, it carries on"
        )
    reason = " ".join(str(getattr(error, "server_message", None) or error).split())[:300]
    return f"{status} from the Hub ({reason}), expected the request to be taken"
