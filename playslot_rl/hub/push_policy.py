"""A model folder to the Hub: loaded first, sent in one commit, compared with what the Hub then lists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from playslot_rl.errors import CheckpointError
from playslot_rl.hub.compare import KEPT, Pushed, check_remote, check_tag, own_card, size_of
from playslot_rl.hub.layout import RemoteFile, same_content
from playslot_rl.hub.push import MAIN
from playslot_rl.hub.session import open_repository
from playslot_rl.sharing.card import is_ours
from playslot_rl.sharing.folder import CARD, FILES, load_pretrained


@dataclass(frozen=True)
class PolicyPushResult(Pushed):
    """What a push of a policy did.

    Attributes:
        tag: set on the commit; empty for none.
        fingerprint: of the weights.
        size: bytes of all files.
        card_kept: whether a card written by hand on the Hub was left as it is.
    """

    tag: str
    fingerprint: str
    size: int
    card_kept: bool

    def lines(self) -> list[str]:
        """For people."""
        lines = self.head(f"{self.size / 1e6:.1f} MB, weights {self.fingerprint}")
        if self.tag:
            lines.append(f"tag: {self.tag}")
        if self.card_kept:
            lines.append(f"card: the one written by hand is kept ({CARD})")
        return lines


def push_policy(
    folder: Path,
    repo_id: str,
    *,
    private: bool,
    branch: str | None = None,
    tag: str | None = None,
    token: str | None = None,
) -> PolicyPushResult:
    """Upload a policy. An interrupted push changes nothing there; the same command carries on.

    Other files of the repository, such as videos or results of others, stay as they are.

    Args:
        folder: made by `playslot export`; nothing is written into it.
        repo_id: `user/name`; made if it is not there.
        private: make it private; refused where it is public.
        branch: made from main if it is not there; None means main.
        tag: a name for the commit; never moved.
        token: None takes HF_TOKEN or what `hf auth login` stored.

    Raises:
        CheckpointError: the folder is not whole, or its files do not belong together.
        HubError: bad names, no or bad token, offline, no network, an error of the Hub, or a tag that is taken.
    """
    _, config = load_pretrained(folder)
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise CheckpointError(f"{folder}: {missing[0]} is missing, expected a whole policy: export it again")
    target = branch or MAIN
    with open_repository(repo_id, folder, token=token, writing=True, revision=target, kind="model") as hub:
        hub.check_token()
        is_private = hub.create(private)
        branches, tags = hub.refs()
        if target not in branches:
            hub.make_branch(target)
        head = hub.commit_of(target)
        remote = hub.tree(head)
        content: dict[str, Path | bytes] = {name: folder / name for name in FILES}
        kept = own_card(hub, folder, head, remote, is_ours) == KEPT
        if kept:
            del content[CARD]
        check_tag(hub, tag, tags, content, lambda _: False)
        changed = {path: item for path, item in content.items() if not _there(item, remote.get(path))}
        commit = head
        if changed:
            commit = hub.commit(content, (), f"PlaySlot policy, weights {config.fingerprint}", target, head)
            sizes = {path: size_of(item) for path, item in content.items()}
            check_remote(hub, commit, sizes, lambda _: False)
        if tag is not None and tag not in tags:
            hub.set_tag(tag, commit, replace=False)
    size = sum((folder / name).stat().st_size for name in content)
    return PolicyPushResult(
        hub.name, hub.address, target, commit, bool(changed), is_private, tag or "", config.fingerprint, size, kept
    )


def _there(item: Path | bytes, remote: RemoteFile | None) -> bool:
    return remote is not None and same_content(item, remote)
