"""A policy from the Hub, into the cache: every file compared with what the Hub lists."""

from __future__ import annotations

import shutil
from pathlib import Path

from playslot_rl.data.cache import build_once, cache_folder
from playslot_rl.errors import CheckpointError
from playslot_rl.hub.session import open_repository
from playslot_rl.sharing.config import CONFIG, WEIGHTS
from playslot_rl.sharing.folder import FILES


def pull_policy(repo_id: str, revision: str = "", cache: str | Path = "", token: str | None = None) -> Path:
    """Download a policy, unless that commit of it is in the cache.

    Args:
        repo_id: `user/name`.
        revision: branch, tag or commit; empty means main.
        cache: folder of the caches; empty means `$PLAYSLOT_CACHE`, or else `~/.cache/playslot_rl`.
        token: None takes HF_TOKEN or what `hf auth login` stored; not needed for public models.

    Returns:
        The model folder.

    Raises:
        CheckpointError: the repository holds no policy.
        HubError: no such repository or revision, a bad token, offline, no network, damaged files, an error of the Hub.
        OutputError: full disk.
    """
    home = cache_folder(cache) / "policies" / repo_id.replace("/", "--")
    with open_repository(repo_id, home, token=token, writing=False, revision=revision, kind="model") as hub:
        commit = hub.commit_of(revision or "main")

        def fetch(folder: Path) -> None:
            wanted = {path: file for path, file in hub.tree(commit).items() if path in FILES}
            for name in (CONFIG, WEIGHTS):
                if name not in wanted:
                    raise CheckpointError(f"{hub.name}: got no {name}, expected a PlaySlot policy: check the name")
            hub.download(wanted, commit, folder)
            shutil.rmtree(folder / ".cache", ignore_errors=True)

        return build_once(home / commit, fetch)
