"""What a push compares: a tag, a card and a commit on the Hub with what is about to be, or was, sent."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from playslot_rl.errors import HubError
from playslot_rl.hub.layout import CARD_NAME, RemoteFile, same_content
from playslot_rl.hub.session import Repository

KEPT: Final = "kept"


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
    """

    repo_id: str
    address: str
    branch: str
    commit: str
    changed: bool
    private: bool

    def head(self, what: str) -> list[str]:
        """The first lines for people, of `what` was sent."""
        done = "pushed" if self.changed else "nothing to push: the Hub has the same files already"
        return [
            f"{done}: {what}",
            f"to: {self.address} ({'private' if self.private else 'public'}), branch {self.branch}",
            f"commit: {self.commit}",
        ]


def few(paths: tuple[str, ...]) -> str:
    """The first three, and how many more."""
    more = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
    return ", ".join(paths[:3]) + more


def size_of(item: Path | bytes) -> int:
    """Bytes of a file's content."""
    return len(item) if isinstance(item, bytes) else item.stat().st_size


def check_tag(
    hub: Repository,
    tag: str | None,
    tags: Mapping[str, str],
    content: Mapping[str, Path | bytes],
    owned: Callable[[str], bool],
) -> None:
    """A tag never moves: it may be there already only where it names exactly what is pushed.

    Args:
        hub: opened.
        tag: asked for; None for none.
        tags: on the Hub, with their commits.
        content: what is pushed, by path.
        owned: which paths there must be part of `content`.

    Raises:
        HubError: the tag is on a commit that holds something else.
    """
    if tag is None or tag not in tags:
        return
    tagged = hub.tree(tags[tag])
    same = {path for path in tagged if owned(path)} <= content.keys() and all(
        path in tagged and same_content(item, tagged[path]) for path, item in content.items()
    )
    if not same:
        raise HubError(
            f"tag={tag}: {hub.name} has it on commit {tags[tag][:12]}, which holds something else, expected a new "
            "name: tags are not moved, choose another"
        )


def own_card(
    hub: Repository, root: Path, head: str, remote: dict[str, RemoteFile], is_ours: Callable[[str], bool]
) -> Path | Literal["", "kept"]:
    """A card written by hand: the one in the folder, else `KEPT` for the one on the Hub; empty if there is none."""
    local = root / CARD_NAME
    if local.is_file() and not is_ours(local.read_text(errors="replace")):
        return local
    if CARD_NAME not in remote:
        return ""
    with tempfile.TemporaryDirectory(prefix="playslot-card-") as folder:
        there = hub.read(CARD_NAME, head, Path(folder)).decode(errors="replace")
    return "" if is_ours(there) else KEPT


def check_remote(hub: Repository, commit: str, expected: Mapping[str, int], owned: Callable[[str], bool]) -> None:
    """Compare the commit's tree with what was sent.

    Args:
        hub: opened.
        commit: to look at.
        expected: bytes by path.
        owned: which further paths must not be there.

    Raises:
        HubError: a file is missing, differs in size, or is foreign.
    """
    listed = hub.tree(commit)
    wrong = [path for path, size in expected.items() if path not in listed or listed[path].size != size]
    extra = [path for path in listed if owned(path) and path not in expected]
    if wrong or extra:
        raise HubError(
            f"{hub.name}: got commit {commit[:12]} with {len(wrong)} missing or different and {len(extra)} foreign "
            f"files ({few(tuple(wrong + extra))}), expected exactly the local ones: run the same command again"
        )
