"""One conversation with the Hub: checked before it starts, retried while it lasts, its errors translated.

Everything of `huggingface_hub` that this package uses is called here; it is imported when a conversation starts, not
before, because it reads HF_ENDPOINT, HF_HOME, HF_TOKEN and HF_HUB_OFFLINE when it is imported.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from playslot_rl.errors import HubError, PlaySlotError
from playslot_rl.hub.errors import Place, bad_name, no_token, offline, translate
from playslot_rl.hub.layout import RemoteFile
from playslot_rl.hub.secrets import Redactor, checked_token

WAITS = (1.0, 2.0, 4.0)
"""Seconds before each further attempt after a server error."""
SECONDS = 120.0
"""Longest silence of the Hub; the client's own default is to wait for ever."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*/[A-Za-z0-9][A-Za-z0-9._-]*")
Kind = Literal["dataset", "model"]
WORDS: Final[dict[Kind, str]] = {"dataset": "data set", "model": "model"}
_PAGES: Final[dict[Kind, str]] = {"dataset": "datasets/", "model": ""}


@dataclass(frozen=True)
class Repository:
    """A data set or model on the Hub, and how to talk about it.

    Attributes:
        place: for messages.
        api: `huggingface_hub.HfApi` with the token.
        kind: what it is.
    """

    place: Place
    api: Any
    kind: Kind = "dataset"

    @property
    def name(self) -> str:
        """`user/name`."""
        return self.place.repo_id

    @property
    def address(self) -> str:
        """Its page."""
        return f"{self.place.endpoint}/{_PAGES[self.kind]}{self.name}"

    def call(self, function: Callable[..., Any], **arguments: Any) -> Any:
        """Call the Hub, again after a server error or a broken connection (not where there is none).

        The client itself retries some of its requests, not all.
        """
        for wait in (*WAITS, None):
            _limit_silence()
            try:
                return function(**arguments)
            except Exception as error:
                if wait is None or not _passing(error):
                    raise
                time.sleep(wait)
        raise AssertionError("unreachable")

    def check_token(self) -> None:
        """Ask the Hub who we are: tells a bad token from every other 401.

        Raises:
            HubError: it is not valid.
        """
        self.call(self.api.whoami)

    def create(self, private: bool) -> bool:
        """Make the repository if it is not there.

        Returns:
            Whether it is private.

        Raises:
            HubError: it is there and public, though `private` is asked for.
        """
        self.call(self.api.create_repo, repo_id=self.name, repo_type=self.kind, private=private, exist_ok=True)
        is_private = bool(self.call(self.api.repo_info, repo_id=self.name, repo_type=self.kind).private)
        if private and not is_private:
            raise HubError(
                f"{self.name}: got a public {self.place.what}, expected a private one: make it private in its settings "
                "on the Hub, or push to another name"
            )
        return is_private

    def refs(self) -> tuple[dict[str, str], dict[str, str]]:
        """Commits of the branches and of the tags, by name."""
        refs = self.call(self.api.list_repo_refs, repo_id=self.name, repo_type=self.kind)
        return ({ref.name: ref.target_commit for ref in refs.branches},
                {ref.name: ref.target_commit for ref in refs.tags})  # fmt: skip

    def commit_of(self, revision: str) -> str:
        """Full commit of a branch, tag or commit."""
        info = self.call(self.api.repo_info, repo_id=self.name, repo_type=self.kind, revision=revision)
        return str(info.sha)

    def tree(self, commit: str) -> dict[str, RemoteFile]:
        """All files of a commit, by path."""

        def listed() -> list[Any]:
            entries = self.api.list_repo_tree(repo_id=self.name, repo_type=self.kind, revision=commit, recursive=True)
            return list(entries)

        files: dict[str, RemoteFile] = {}
        for entry in self.call(listed):
            if not hasattr(entry, "blob_id"):
                continue  # a folder
            sha256 = entry.lfs.sha256 if entry.lfs else None
            files[entry.path] = RemoteFile(int(entry.size), sha256, str(entry.blob_id))
        return files

    def make_branch(self, branch: str) -> None:
        """A branch from main."""
        self.call(self.api.create_branch, repo_id=self.name, repo_type=self.kind, branch=branch, exist_ok=True)

    def set_tag(self, tag: str, commit: str, *, replace: bool) -> None:
        """Name a commit. Moving a tag is two requests: after a failure in between the same push sets it."""
        if replace:
            self.call(self.api.delete_tag, repo_id=self.name, repo_type=self.kind, tag=tag)
        self.call(self.api.create_tag, repo_id=self.name, repo_type=self.kind, tag=tag, revision=commit, exist_ok=True)

    def commit(self, files: dict[str, Path | bytes], stale: Sequence[str], message: str, branch: str, head: str) -> str:
        """Add `files` and delete `stale` in one commit on top of `head`; nothing is visible before it.

        Note: `HfApi.upload_folder` (with `delete_patterns`) uploads in several commits where hf_xet is installed, so a
        reader could meet half a data set: we name the operations ourselves.

        Returns:
            The commit; `head` itself if nothing differs.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        def send() -> str:
            operations: list[Any] = [CommitOperationDelete(path, is_folder=False) for path in stale]
            operations += [CommitOperationAdd(path, content) for path, content in files.items()]
            info = self.api.create_commit(repo_id=self.name, repo_type=self.kind, operations=operations,
                                          revision=branch, commit_message=message, parent_commit=head)  # fmt: skip
            return str(info.oid)

        return str(self.call(send))

    def read(self, path: str, commit: str, folder: Path) -> bytes:
        """Content of one file, downloaded below `folder`."""
        got = self.call(self.api.hf_hub_download, repo_id=self.name, repo_type=self.kind, filename=path,
                        revision=commit, local_dir=folder)  # fmt: skip
        return Path(got).read_bytes()

    def download(self, paths: Sequence[str], commit: str, folder: Path) -> None:
        """Fetch files; those already there and whole stay.

        `commit` has to be a full commit: for a name the client takes what lies in `folder` where the Hub does not
        answer, and says nothing.
        """
        pattern = [_literal(path) for path in paths]
        self.call(self.api.snapshot_download, repo_id=self.name, repo_type=self.kind, revision=commit, local_dir=folder,
                  allow_patterns=pattern)  # fmt: skip


def _literal(path: str) -> str:
    """A path as a pattern that matches only it."""
    return re.sub(r"([*?[])", r"[\1]", path)


def _passing(error: BaseException) -> bool:
    """Whether the next attempt may do better."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError

    if isinstance(error, HfHubHTTPError):
        return error.response.status_code in (408, 500, 502, 503, 504)
    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
        return False
    return isinstance(error, httpx.NetworkError | httpx.TimeoutException | httpx.RemoteProtocolError)


def _limit_silence() -> None:
    """A dead connection must end: the shared client waits for ever unless someone has set a limit."""
    import httpx
    from huggingface_hub import get_session

    client = get_session()
    if client.timeout == httpx.Timeout(None):
        client.timeout = httpx.Timeout(SECONDS, connect=15.0)


@contextlib.contextmanager
def open_repository(
    repo_id: str, root: Path, *, token: str | None, writing: bool, revision: str = "", kind: Kind = "dataset"
) -> Iterator[Repository]:
    """Talk to the Hub about one data set or model.

    Args:
        repo_id: `user/name`.
        root: local folder, for messages.
        token: None takes HF_TOKEN or what `hf auth login` stored.
        writing: needs a token.
        revision: asked for, for messages.
        kind: what the repository is.

    Raises:
        HubError: a bad name, offline mode, no token, or anything that goes wrong inside, in one line without tokens.
        OutputError: full disk or a folder that cannot be written.
    """
    from huggingface_hub import HfApi, constants, get_token, is_offline_mode

    token = checked_token(token) or checked_token(get_token())
    redactor = Redactor(token)
    name, endpoint = redactor.text(repo_id), redactor.text(constants.ENDPOINT)
    place = Place(name, endpoint, root, writing, token is not None, revision, WORDS[kind])
    if not _NAME.fullmatch(repo_id):
        raise bad_name(place)
    if is_offline_mode():
        raise offline(place)
    if writing and token is None:
        raise no_token(place)
    with redactor.logs():
        try:
            yield Repository(place, HfApi(token=token or False, library_name="playslot_rl"), kind)
        except PlaySlotError as error:
            redactor.error(error)
            raise
        except Exception as error:
            redactor.error(error)
            known = translate(error, place)
            if known is None:
                raise
            redactor.error(known)
            raise known from error
