"""One conversation with the Hub: checked before it starts, retried while it lasts, its errors translated.

Everything of `huggingface_hub` that this package uses is called here; it is imported when a conversation starts, not
before, because it reads HF_ENDPOINT, HF_HOME, HF_TOKEN and HF_HUB_OFFLINE when it is imported.
"""

from __future__ import annotations

import contextlib
import glob
import re
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from playslot_rl.errors import HubError
from playslot_rl.hub.errors import Place, checked_token, mask, masked_logs, translate
from playslot_rl.hub.layout import same_content

if TYPE_CHECKING:
    from huggingface_hub import RepoFile

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

    def tree(self, commit: str) -> dict[str, RepoFile]:
        """All files of a commit, by path."""
        from huggingface_hub import RepoFile

        def listed() -> list[Any]:
            return list(self.api.list_repo_tree(self.name, repo_type=self.kind, revision=commit, recursive=True))

        return {entry.path: entry for entry in self.call(listed) if isinstance(entry, RepoFile)}

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

    def download(self, files: Mapping[str, RepoFile], commit: str, folder: Path) -> None:
        """Fetch files and compare each with what the Hub lists; those already there and whole stay.

        `commit` has to be a full commit: for a name the client takes what lies in `folder` where the Hub does not
        answer, and says nothing.

        Raises:
            HubError: the size or hash of a file is another; such files are removed.
        """
        self.call(self.api.snapshot_download, repo_id=self.name, repo_type=self.kind, revision=commit, local_dir=folder,
                  allow_patterns=[glob.escape(path) for path in files])  # fmt: skip
        damaged = [path for path, file in files.items() if not same_content(folder / path, file)]
        for path in damaged:
            (folder / path).unlink(missing_ok=True)
            (folder / ".cache" / "huggingface" / "download" / f"{path}.metadata").unlink(missing_ok=True)
        if damaged:
            raise HubError(
                f"{self.name}: got {len(damaged)} damaged files ({', '.join(damaged[:3])}), expected what the Hub "
                "lists: run the same command again, it fetches these anew"
            )


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
        PlaySlotError: another error from inside, its message without tokens.
    """
    from huggingface_hub import HfApi, constants, errors, get_token, is_offline_mode

    token = checked_token(token) or checked_token(get_token())
    name, endpoint = mask(repo_id, token), mask(constants.ENDPOINT, token)
    place = Place(name, endpoint, root, writing, token is not None, revision, WORDS[kind])
    try:
        if not _NAME.fullmatch(repo_id):
            raise errors.HFValidationError(repo_id)
        if is_offline_mode():
            raise errors.OfflineModeIsEnabled
        if writing and token is None:
            raise errors.LocalTokenNotFoundError
        with masked_logs(token):
            yield Repository(place, HfApi(token=token or False, library_name="playslot_rl"), kind)
        return
    except Exception as error:  # noqa: BLE001 - nothing that may hold a token goes on as it is
        known = translate(error, place)
        failure = type(known)(mask(str(known), token))
        failure.add_note(mask("".join(traceback.format_exception(error)), token))
    # A server may repeat the token it was sent, and the client's errors hold its answer: their masked text goes along
    # as a note, they themselves do not.
    try:
        raise failure
    finally:
        failure.__context__ = None
