"""Policies to and from the Hub: loaded before they go, sent in one commit, and every file compared on both ways."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from playslot_rl.data.cache import build_once, cache_folder
from playslot_rl.errors import CheckpointError
from playslot_rl.hub.session import MAIN, Pushed, open_repository, send
from playslot_rl.sharing.card import MARK
from playslot_rl.sharing.folder import CONFIG, FILES, RANGE, WEIGHTS, files_of, require_whole


@dataclass(frozen=True)
class PolicyPushResult(Pushed):
    fingerprint: str

    def lines(self) -> list[str]:
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
    """Upload the folder of a policy; other files of the repository, such as videos, stay as they are. Otherwise as
    `playslot_rl.hub.push.push`, with a CheckpointError where the folder is not whole.
    """
    config = require_whole(folder)
    files: dict[str, Path | bytes] = {name: folder / name for name in files_of(config)}
    message = f"PlaySlot policy, weights {config.fingerprint}"
    target = branch or MAIN
    with open_repository(repo_id, folder, token=token, writing=True, revision=target, kind="model") as hub:
        sent = send(hub, folder, files, mark=MARK, message=message, private=private, branch=target, tag=tag)
    return PolicyPushResult(**vars(sent), fingerprint=config.fingerprint)


def pull_policy(repo_id: str, revision: str = "", cache: str | Path = "", token: str | None = None) -> Path:
    """Download a policy, unless that commit of it is in the cache, and return the model folder.

    Raises:
        CheckpointError: the repository holds no policy.
        HubError: no such repository or revision, a bad token, offline, no network, damaged files, an error of the Hub.
    """
    home = cache_folder(cache) / "policies" / repo_id.replace("/", "--")
    with open_repository(repo_id, home, token=token, writing=False, revision=revision, kind="model") as hub:
        commit = hub.commit_of(revision or MAIN)

        def fetch(folder: Path) -> None:
            wanted = {path: file for path, file in hub.tree(commit).items() if path in (*FILES, RANGE)}
            for name in (CONFIG, WEIGHTS):
                if name not in wanted:
                    raise CheckpointError(f"{hub.name}: got no {name}, expected a PlaySlot policy: check the name")
            hub.download(wanted, commit, folder)
            shutil.rmtree(folder / ".cache", ignore_errors=True)

        return build_once(home / commit, fetch)
