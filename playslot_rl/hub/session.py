"""One conversation with the Hub: checked before it starts, retried while it lasts, its errors translated.

Everything of `huggingface_hub` that this package uses is called here; it is imported when a conversation starts, not
before, because it reads HF_ENDPOINT, HF_HOME, HF_TOKEN and HF_HUB_OFFLINE when it is imported.
"""

from __future__ import annotations

import contextlib
import glob
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from playslot_rl.data.places import inside
from playslot_rl.data.remote import Asked, one_line
from playslot_rl.errors import HubError
from playslot_rl.hub.layout import CARD_NAME, same_content, size_of
from playslot_rl.storage.secrets import checked_token, mask

if TYPE_CHECKING:
    from huggingface_hub import RepoFile


WAITS = (1.0, 2.0, 4.0)
"""Seconds before each further attempt after a server error."""
SECONDS = 120.0
"""Longest silence of the Hub; the client's own default is to wait for ever."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*/[A-Za-z0-9][A-Za-z0-9._-]*")
Kind = Literal["dataset", "model"]


@dataclass(frozen=True)
class Repository(Asked):
    """A data set or model on the Hub, and how to talk about it; `api` is a `huggingface_hub.HfApi` with the token."""

    kind: Kind
    api: Any

    @property
    def here(self) -> dict[str, str]:
        """The arguments of the client's calls that name it."""
        return {"repo_id": self.name, "repo_type": self.kind}

    @property
    def address(self) -> str:
        return f"{self.endpoint}/{'datasets/' if self.kind == 'dataset' else ''}{self.name}"

    def call(self, function: Callable[..., Any], **arguments: Any) -> Any:
        """Call the Hub, again after a server error or a broken connection: the client retries only some requests."""
        for wait in (*WAITS, None):
            _limit_silence()
            try:
                return function(**arguments)
            except Exception as error:
                if wait is None or not _passing(error):
                    raise
                time.sleep(wait)
        raise AssertionError("unreachable")

    def create(self, private: bool) -> bool:
        """Make the repository if it is not there; whether it is private. A HubError where it is there and public,
        though `private` is asked for.
        """
        self.call(self.api.create_repo, **self.here, private=private, exist_ok=True)
        is_private = bool(self.call(self.api.repo_info, **self.here).private)
        if private and not is_private:
            raise HubError(
                f"{self.name}: got a public {self.what}, expected a private one: make it private in its settings "
                "on the Hub, or push to another name"
            )
        return is_private

    def refs(self) -> tuple[dict[str, str], dict[str, str]]:
        refs = self.call(self.api.list_repo_refs, **self.here)
        return ({ref.name: ref.target_commit for ref in refs.branches},
                {ref.name: ref.target_commit for ref in refs.tags})  # fmt: skip

    def commit_of(self, revision: str) -> str:
        info = self.call(self.api.repo_info, **self.here, revision=revision)
        return str(info.sha)

    def tree(self, commit: str) -> dict[str, RepoFile]:
        from huggingface_hub import RepoFile

        def listed() -> list[Any]:
            return list(self.api.list_repo_tree(self.name, repo_type=self.kind, revision=commit, recursive=True))

        return {entry.path: entry for entry in self.call(listed) if isinstance(entry, RepoFile)}

    def set_tag(self, tag: str, commit: str, *, replace: bool) -> None:
        """Name a commit. Moving a tag is two requests: after a failure in between the same push sets it."""
        if replace:
            self.call(self.api.delete_tag, **self.here, tag=tag)
        self.call(self.api.create_tag, **self.here, tag=tag, revision=commit, exist_ok=True)

    def commit(self, files: dict[str, Path | bytes], stale: Sequence[str], message: str, branch: str, head: str) -> str:
        """Add `files` and delete `stale` in one commit on top of `head`; returns it, or `head` if nothing differs.

        Note: `HfApi.upload_folder` (with `delete_patterns`) uploads in several commits where hf_xet is installed, so a
        reader could meet half a data set: we name the operations ourselves.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        def send() -> str:
            operations: list[Any] = [CommitOperationDelete(path, is_folder=False) for path in stale]
            operations += [CommitOperationAdd(path, content) for path, content in files.items()]
            info = self.api.create_commit(**self.here, operations=operations,
                                          revision=branch, commit_message=message, parent_commit=head)  # fmt: skip
            return str(info.oid)

        return str(self.call(send))

    def read(self, path: str, commit: str, folder: Path) -> bytes:
        """Content of one file, downloaded below `folder`."""
        got = self.call(self.api.hf_hub_download, **self.here, filename=path, revision=commit, local_dir=folder)
        return Path(got).read_bytes()

    def download(self, files: Mapping[str, RepoFile], commit: str, folder: Path) -> None:
        """Fetch files and compare each with what the Hub lists; those already there and whole stay, those of another
        size or hash are removed (HubError).

        `commit` has to be a full commit: for a name the client takes what lies in `folder` where the Hub does not
        answer, and says nothing.
        """
        self.call(self.api.snapshot_download, **self.here, revision=commit, local_dir=folder,
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
    """Talk to the Hub about one data set or model; without a token by HF_TOKEN or what `hf auth login` stored. Whatever
    goes wrong inside is a HubError, or an error of ours, in one line without tokens.
    """
    from huggingface_hub import HfApi, constants, errors, get_token, is_offline_mode

    token = checked_token(token) or checked_token(get_token())
    name, endpoint = mask(repo_id, token), mask(constants.ENDPOINT, token)
    api = HfApi(token=token or False, library_name="playslot_rl")
    what = "data set" if kind == "dataset" else "model"
    hub = Repository(name, what, endpoint, root, revision, writing, token is not None, kind, api)
    with one_line(hub, token):
        if not _NAME.fullmatch(repo_id):
            raise errors.HFValidationError(repo_id)
        if is_offline_mode():
            raise errors.OfflineModeIsEnabled
        if writing and token is None:
            raise errors.LocalTokenNotFoundError
        yield hub


MAIN: Final = "main"
Owned = Callable[[str], bool]
"""Whether a path belongs to what is pushed."""


@dataclass(frozen=True)
class Pushed:
    """What every push says: also which files were deleted on the Hub because they are no longer part of it, and whether
    the card is one that somebody wrote by hand.
    """

    repo_id: str
    address: str
    branch: str
    commit: str
    changed: bool
    private: bool
    tags: tuple[str, ...]
    files: int
    size: int
    stale: tuple[str, ...]
    card_kept: bool

    def report(self, what: str, more: Iterable[str] = ()) -> list[str]:
        """For people: `what` was sent, and `more` to say of it."""
        done = "pushed" if self.changed else "nothing to push: the Hub has the same files already"
        lines = [
            f"{done}: {what}",
            f"to: {self.address} ({'private' if self.private else 'public'}), branch {self.branch}",
            f"commit: {self.commit}",
        ]
        if self.tags:
            lines.append(f"tag: {', '.join(self.tags)}")
        lines += more
        if self.card_kept:
            lines.append(f"card: the one written by hand is kept ({CARD_NAME})")
        return lines


def few(paths: tuple[str, ...]) -> str:
    """The first three, and how many more."""
    more = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
    return ", ".join(paths[:3]) + more


def send(
    hub: Repository,
    root: Path,
    files: dict[str, Path | bytes],
    *,
    mark: str,
    message: str,
    private: bool,
    branch: str,
    tag: str | None,
    version: str = "",
    owned: Owned = lambda _: False,
) -> Pushed:
    """Push, or find that everything is there already. Nothing is visible on the Hub before the one commit.

    Args:
        root: local folder, which may hold a card written by hand.
        files: what to send, by path, with the card as it is made here, known by the line `mark`.
        branch: made from main if it is not there.
        tag: one more tag for the commit; never moved. A HubError where it is on something else.
        version: tag that moves to the commit; empty for none.
        owned: which paths there must be part of `files`; others are left alone.
    """
    hub.call(hub.api.whoami)  # tells a bad token from every other 401
    is_private = hub.create(private)
    branches, tags = hub.refs()
    if branch not in branches:
        hub.call(hub.api.create_branch, **hub.here, branch=branch, exist_ok=True)
    head = hub.commit_of(branch)
    remote = hub.tree(head)
    local = root / CARD_NAME
    by_hand = local.is_file() and inside(root, local) and mark not in local.read_text(errors="replace")
    if by_hand:
        files = {**files, CARD_NAME: local}
    elif CARD_NAME in remote and mark not in _read(hub, CARD_NAME, head):
        by_hand = True
        files = {path: item for path, item in files.items() if path != CARD_NAME}
    if tag is not None and tag in tags:
        _check_tag(hub, tag, tags[tag], files, owned)
    stale = tuple(sorted(path for path in remote if owned(path) and path not in files))
    sizes = {path: size_of(item) for path, item in files.items()}
    commit = hub.commit(files, stale, message, branch, head)
    _check_remote(hub, commit, sizes, owned)
    if version and tags.get(version) != commit:
        hub.set_tag(version, commit, replace=version in tags)
    if tag is not None and tag not in tags:
        hub.set_tag(tag, commit, replace=False)
    return Pushed(
        hub.name, hub.address, branch, commit, commit != head, is_private,
        tuple(name for name in (version, tag) if name), len(sizes), sum(sizes.values()), stale, by_hand,
    )  # fmt: skip


def _read(hub: Repository, path: str, commit: str) -> str:
    with tempfile.TemporaryDirectory(prefix="playslot-card-") as folder:
        return hub.read(path, commit, Path(folder)).decode(errors="replace")


def _check_tag(hub: Repository, tag: str, commit: str, files: Mapping[str, Path | bytes], owned: Owned) -> None:
    """A tag never moves: it may be there already only where it names exactly what is pushed."""
    tagged = hub.tree(commit)
    same = {path for path in tagged if owned(path)} <= files.keys() and all(
        path in tagged and same_content(item, tagged[path]) for path, item in files.items()
    )
    if not same:
        raise HubError(
            f"tag={tag}: {hub.name} has it on commit {commit[:12]}, which holds something else, expected a new name: "
            "tags are not moved, choose another"
        )


def _check_remote(hub: Repository, commit: str, sizes: Mapping[str, int], owned: Owned) -> None:
    """Compare the commit's tree with what was sent: bytes by path, and no further path that is owned."""
    listed = hub.tree(commit)
    wrong = [path for path, size in sizes.items() if path not in listed or listed[path].size != size]
    extra = [path for path in listed if owned(path) and path not in sizes]
    if wrong or extra:
        raise HubError(
            f"{hub.name}: got commit {commit[:12]} with {len(wrong)} missing or different and {len(extra)} foreign "
            f"files ({few(tuple(wrong + extra))}), expected exactly the local ones: run the same command again"
        )
