"""A model folder to the Hub: loaded first, sent in one commit, compared with what the Hub then lists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from playslot_rl.errors import CheckpointError
from playslot_rl.hub.sending import MAIN, Parcel, Pushed, send
from playslot_rl.hub.session import open_repository
from playslot_rl.sharing.card import MARK
from playslot_rl.sharing.folder import FILES, load_pretrained


@dataclass(frozen=True)
class PolicyPushResult(Pushed):
    """What a push of a policy did.

    Attributes:
        fingerprint: of the weights.
    """

    fingerprint: str

    def lines(self) -> list[str]:
        """For people."""
        return self.report(f"{self.size / 1e6:.1f} MB, weights {self.fingerprint}")


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
    parcel = Parcel({name: folder / name for name in FILES}, MARK, f"PlaySlot policy, weights {config.fingerprint}")
    target = branch or MAIN
    with open_repository(repo_id, folder, token=token, writing=True, revision=target, kind="model") as hub:
        sent = send(hub, folder, parcel, private=private, branch=target, tag=tag)
    return PolicyPushResult(**vars(sent), fingerprint=config.fingerprint)
