"""A data set to the Hub: checked first, sent in one commit, compared with what the Hub then lists."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from playslot_rl.data.contents import open_files
from playslot_rl.errors import HubError
from playslot_rl.hub.card import is_ours, make_card
from playslot_rl.hub.checks import check_before_push
from playslot_rl.hub.compare import KEPT, Pushed, check_remote, check_tag, few, own_card, size_of
from playslot_rl.hub.layout import CARD_NAME, REMOTE_RECORD, is_data, local_files
from playslot_rl.hub.record import HubRecord
from playslot_rl.hub.session import Repository, open_repository

MAIN = "main"
_VERSION = re.compile(r"v?\d+(\.\d+)*")


@dataclass(frozen=True)
class PushResult(Pushed):
    """What a push of a data set did.

    Attributes:
        tags: set on the commit.
        record: fingerprint and counts.
        files, size: how many files and bytes the data set has there.
        stale: files deleted on the Hub because they are no longer part of the data set.
        left: local files that stayed here.
        card: `made`, or `kept` where somebody wrote one by hand.
    """

    tags: tuple[str, ...]
    record: HubRecord
    files: int
    size: int
    stale: tuple[str, ...]
    left: tuple[str, ...]
    card: str

    def lines(self) -> list[str]:
        """For people."""
        record = self.record
        counts = f"{record.episodes} episodes, {record.frames} frames, {self.files} files"
        lines = self.head(f"{counts} of {self.size / 1e6:.1f} MB, fingerprint {record.fingerprint}")
        if self.tags:
            lines.append(f"tag: {', '.join(self.tags)}")
        else:
            lines.append(f"tag: none moved; pull this branch by revision={self.branch}")
        if self.stale:
            lines.append(f"deleted on the Hub: {few(self.stale)}")
        if self.left:
            lines.append(f"not uploaded: {few(self.left)}")
        if self.card == "kept":
            lines.append(f"card: the one written by hand is kept ({CARD_NAME})")
        return lines


def push(
    root: Path, repo_id: str, *, private: bool, branch: str | None = None, tag: str | None = None,
    token: str | None = None,
) -> PushResult:  # fmt: skip
    """Upload a LeRobot data set. An interrupted push changes nothing there; the same command carries on.

    Args:
        root: its folder; nothing is written into it.
        repo_id: `user/name`; made if it is not there.
        private: make it private; refused where it is public.
        branch: made from main if it is not there; None means main. The version tag moves with main only.
        tag: one more tag for the commit; never moved.
        token: None takes HF_TOKEN or what `hf auth login` stored.

    Raises:
        DataError: the data set is not whole.
        HubError: bad names, no or bad token, offline, no network, an error of the Hub, or a tag that is taken.
    """
    root = Path(root).expanduser()
    checked = check_before_push(root)
    files = open_files(root)
    target = branch or MAIN
    _check_names(target, tag, str(files.info["codebase_version"]))
    with open_repository(repo_id, root, token=token, writing=True, revision=target) as hub:
        hub.check_token()
        record = HubRecord.of(checked)
        is_private = hub.create(private)
        branches, tags = hub.refs()
        if target not in branches:
            hub.make_branch(target)
        head = hub.commit_of(target)
        remote = hub.tree(head)
        sizes, left = local_files(root)
        content: dict[str, Path | bytes] = {path: root / path for path in sizes}
        content[REMOTE_RECORD] = record.to_bytes()
        card = own_card(hub, root, head, remote, is_ours)
        if card != KEPT:
            content[CARD_NAME] = card or make_card(files, hub.name, record).encode()
        expected = {path: sizes.get(path, size_of(item)) for path, item in content.items()}
        stale = tuple(sorted(path for path in remote if is_data(path) and path not in content))
        check_tag(hub, tag, tags, content, is_data)
        message = f"{record.episodes} episodes, {record.frames} frames, fingerprint {record.fingerprint}"
        commit = hub.commit(content, stale, message, target, head)
        check_remote(hub, commit, expected, is_data)
        version = str(files.info["codebase_version"]) if target == MAIN else None
        set_tags = _set_tags(hub, commit, version, tag, tags)
    return PushResult(
        hub.name, hub.address, target, commit, commit != head, is_private, set_tags, record, len(expected),
        sum(expected.values()), stale, tuple(left), "kept" if card else "made",
    )  # fmt: skip


def _check_names(branch: str, tag: str | None, version: str) -> None:
    """Refuse branches and tags that LeRobot would take for a format version."""
    if branch != MAIN and _VERSION.fullmatch(branch):
        raise HubError(
            f"branch={branch}: got the name of a format version, expected another: LeRobot would load it as that"
        )
    if tag is not None and _VERSION.fullmatch(tag):
        raise HubError(
            f"tag={tag}: got the name of a format version, expected another: LeRobot would load it as that; "
            f"{version} is set by every push to main"
        )


def _set_tags(
    hub: Repository, commit: str, version: str | None, tag: str | None, tags: dict[str, str]
) -> tuple[str, ...]:
    """The version tag moves with main, as LeRobot expects; a tag of the user's is set once."""
    if version is not None and tags.get(version) != commit:
        hub.set_tag(version, commit, replace=version in tags)
    if tag is not None and tag not in tags:
        hub.set_tag(tag, commit, replace=False)
    return tuple(name for name in (version, tag) if name)
