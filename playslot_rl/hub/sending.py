"""What every push does: one commit, compared with what the Hub then lists; cards by hand stay, and tags never move."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from playslot_rl.errors import HubError
from playslot_rl.hub.layout import CARD_NAME, same_content, size_of
from playslot_rl.hub.session import Repository

MAIN: Final = "main"
Owned = Callable[[str], bool]
"""Whether a path belongs to what is pushed."""


@dataclass(frozen=True)
class Pushed:
    """What every push says.

    Attributes:
        repo_id: `user/name`.
        address: its page.
        branch: pushed to.
        commit: what the branch now is.
        changed: whether there was anything to send.
        private: whether the repository is.
        tags: set on the commit.
        files, size: how many files and bytes were compared.
        stale: files deleted on the Hub because they are no longer part of what is pushed.
        card_kept: whether the card is one that somebody wrote by hand.
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
        hub: opened for writing.
        root: local folder, which may hold a card written by hand.
        files: what to send, by path, with the card as it is made here.
        mark: line of a card by which those made here are known.
        message: of the commit.
        private: make it private; refused where it is public.
        branch: made from main if it is not there.
        tag: one more tag for the commit; never moved.
        version: tag that moves to the commit; empty for none.
        owned: which paths there must be part of `files`; others are left alone.

    Raises:
        HubError: what the Hub then lists is not what was sent, or the tag is on something else.
    """
    hub.check_token()
    is_private = hub.create(private)
    branches, tags = hub.refs()
    if branch not in branches:
        hub.make_branch(branch)
    head = hub.commit_of(branch)
    remote = hub.tree(head)
    local = root / CARD_NAME
    by_hand = local.is_file() and mark not in local.read_text(errors="replace")
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
