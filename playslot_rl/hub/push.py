"""A data set to the Hub: checked first, sent in one commit, compared with what the Hub then lists."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from playslot_rl.datasets.info import info
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError, HubError
from playslot_rl.hub.card import MARK, make_card
from playslot_rl.hub.layout import CARD_NAME, REMOTE_RECORD, is_data, local_files
from playslot_rl.hub.record import HubRecord
from playslot_rl.hub.sending import MAIN, Pushed, few, send
from playslot_rl.hub.session import open_repository

_VERSION = re.compile(r"v?\d+(\.\d+)*")


@dataclass(frozen=True)
class PushResult(Pushed):
    """What a push of a data set did.

    Attributes:
        record: fingerprint and counts.
        left: local files that stayed here.
    """

    record: HubRecord
    left: tuple[str, ...]

    def lines(self) -> list[str]:
        """For people."""
        record, more = self.record, []
        if not self.tags:
            more.append(f"tag: none moved; pull this branch by revision={self.branch}")
        if self.stale:
            more.append(f"deleted on the Hub: {few(self.stale)}")
        if self.left:
            more.append(f"not uploaded: {few(self.left)}")
        counts = f"{record.episodes} episodes, {record.frames} frames, {self.files} files"
        return self.report(f"{counts} of {self.size / 1e6:.1f} MB, fingerprint {record.fingerprint}", more)


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
    record = _checked(root)
    summary = info(root)
    target = branch or MAIN
    _check_names(target, tag, summary.format)
    paths, left = local_files(root)
    with open_repository(repo_id, root, token=token, writing=True, revision=target) as hub:
        files: dict[str, Path | bytes] = {path: root / path for path in paths}
        files[REMOTE_RECORD] = record.to_bytes()
        files[CARD_NAME] = make_card(summary, hub.name, record.fingerprint).encode()
        message = f"{record.episodes} episodes, {record.frames} frames, fingerprint {record.fingerprint}"
        sent = send(
            hub, root, files, mark=MARK, message=message, private=private, branch=target, tag=tag,
            version=summary.format if target == MAIN else "", owned=is_data,
        )  # fmt: skip
    return PushResult(**vars(sent), record=record, left=tuple(left))


def _checked(root: Path) -> HubRecord:
    """Everything `playslot dataset verify` checks: others will build on it."""
    result = verify(root)
    if not result.ok:
        more = f" (and {len(result.errors) - 1} more)" if len(result.errors) > 1 else ""
        raise DataError(f"{result.errors[0]}{more}; run `playslot dataset verify {root}` for all of it, then `repair`")
    return HubRecord.of(result.fingerprint, result.episodes, result.frames)


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
