"""A data set from the Hub: fetched beside its place, compared with what the Hub lists, then renamed into place."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.data.cache import build_once, cache_folder
from playslot_rl.data.metadata import FORMAT_TAG, INFO_NAME, read_info
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import CheckpointError, DataError, HubError, OutputError
from playslot_rl.hub.layout import LOCAL_RECORD, SCHEME, HubRecord, is_pulled, read_record, require_plain
from playslot_rl.hub.session import MAIN, Repository, open_repository
from playslot_rl.storage.atomic import explain_write_errors, json_or_nothing, replace_dir, write_bytes, write_json
from playslot_rl.storage.locks import locked

if TYPE_CHECKING:
    from huggingface_hub import RepoFile

SPARE = 64 << 20
"""Bytes to leave free on the disk."""


@dataclass(frozen=True)
class PullResult:
    """What a pull did: why that revision, empty if it was asked for; whether the Hub named a fingerprint to compare it
    with; what is untidy in the data set as it was pushed.
    """

    repo_id: str
    root: str
    revision: str
    why: str
    commit: str
    episodes: int
    frames: int
    files: int
    size: int
    fingerprint: str
    compared: bool
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        checked = "as pushed" if self.compared else "the Hub names none to compare; files and counts were checked"
        return [
            f"pulled: {self.episodes} episodes, {self.frames} frames, {self.files} files of {self.size / 1e6:.1f} MB",
            f"from: {self.repo_id}, revision {self.revision}" + (f" ({self.why})" if self.why else ""),
            f"commit: {self.commit}",
            f"fingerprint: {self.fingerprint} ({checked})",
            f"to: {self.root}",
            *(f"warning: {line}" for line in self.warnings),
        ]


def pull(repo_id: str, root: Path, *, revision: str | None = None, token: str | None = None) -> PullResult:
    """Download a LeRobot data set. After an interruption the same command carries on with the files still missing.

    Args:
        revision: branch, tag or commit; None means the tag of LeRobot's format version, or main where there is none.

    Raises:
        HubError: whatever the Hub says, or a data set that differs from what it lists.
        DataError: it is no LeRobot data set, or of another format version.
        OutputError: `root` holds something, another pull into it is running, or the disk is full.
    """
    root = Path(root).expanduser().absolute()
    if not root.name:
        raise OutputError(f"{root}: got no name of a folder, expected one that can be made: give it a name")
    _refuse_existing(root)
    with open_repository(repo_id, root, token=token, writing=False, revision=revision or "") as hub:
        name, why, commit = _choose(hub, revision)
        listed = hub.tree(commit)
        require_plain((path for path in listed if path.startswith(("data/", "meta/", "videos/"))), hub.name)
        wanted = {path: file for path, file in listed.items() if is_pulled(path)}
        if INFO_NAME not in wanted:
            raise DataError(f"{hub.name}: got no {INFO_NAME} at {name}, expected a LeRobot data set: check the name")
        with explain_write_errors(root):
            root.parent.mkdir(parents=True, exist_ok=True)
        lock = root.with_name(f".{root.name}.pull.lock")
        with locked(lock, f"{root}: got another pull into it running, expected one at a time: wait"):
            try:
                with explain_write_errors(root):
                    _refuse_existing(root)
                    # Where the files gather, also over several calls; those of another commit are never mixed in.
                    partial = root.with_name(f".{root.name}.pull-{commit[:16]}")
                    _check_version(hub, partial, commit)
                    _check_room(root, partial, wanted)
                    hub.download(wanted, commit, partial)
                    record, compared, warnings = _check_content(hub, partial, commit)
                    size = sum(file.size for file in wanted.values())
                    result = PullResult(
                        hub.name, str(root), name, why, commit, record.episodes, record.frames, len(wanted), size,
                        record.fingerprint, compared, warnings,
                    )  # fmt: skip
                    _finish(partial, root, result, hub.endpoint)
            finally:
                lock.unlink(missing_ok=True)
    return result


def _refuse_existing(root: Path) -> None:
    if root.is_dir() and not any(root.iterdir()):
        return
    if root.exists() or root.is_symlink():
        origin = json_or_nothing(root / LOCAL_RECORD)
        pulled = {"commit", "repo_id"} <= origin.keys()  # or nobody can tell from where
        held = f", commit {str(origin['commit'])[:12]} of {origin['repo_id']}" if pulled else ""
        raise OutputError(f"{root}: got a folder that holds something{held}, expected none: choose another, or move it")


def _choose(hub: Repository, revision: str | None) -> tuple[str, str, str]:
    """What to fetch: its name, why, and its commit."""
    if revision:
        return revision, "", hub.commit_of(revision)
    branches, tags = hub.refs()
    if FORMAT_TAG not in tags:
        return "main", f"the Hub has no tag {FORMAT_TAG}", hub.commit_of("main")
    why = "the tag LeRobot loads"
    # A tag may be an object of its own: what it names is asked for, not taken from the list.
    commit = hub.commit_of(FORMAT_TAG)
    if branches.get("main", commit) != commit:
        why += f"; main is another commit, {branches['main'][:12]}: revision=main for that"
    return FORMAT_TAG, why, commit


def _check_version(hub: Repository, partial: Path, commit: str) -> None:
    """Look at the metadata before gigabytes are fetched."""
    hub.read(INFO_NAME, commit, partial)
    try:
        read_info(partial)
    except DataError as error:
        shutil.rmtree(partial, ignore_errors=True)
        said = str(error).removeprefix(f"{partial}: ").replace(f"{partial}/", "")
        raise DataError(f"{hub.name}: {said}; or ask for another revision") from error


def _check_room(root: Path, partial: Path, wanted: Mapping[str, RepoFile]) -> None:
    size = sum(file.size for path, file in wanted.items() if not (partial / path).is_file())
    free = shutil.disk_usage(root.parent).free
    if size + SPARE > free:
        raise OutputError(
            f"cannot write {root}: got {free / 1e6:.0f} MB of free disk, expected {(size + SPARE) / 1e6:.0f} MB; free "
            "some or choose another folder; the same command carries on"
        )


def _check_content(hub: Repository, partial: Path, commit: str) -> tuple[HubRecord, bool, tuple[str, ...]]:
    """What has arrived, which is removed if it is wrong: fetching it again would not help; whether the Hub named a
    fingerprint to compare it with; and what is untidy.
    """
    shutil.rmtree(partial / ".cache", ignore_errors=True)
    try:
        # Counts, indices and every frame. Statistics are not compared: others' may be made in another way.
        seen = verify(partial, statistics=False)
        if not seen.ok:
            first = seen.errors[0].replace(f"{partial}/", "").partition(";")[0]
            raise DataError(
                f"{hub.name}: got a data set at commit {commit[:12]} whose files disagree ({first}), expected a sound "
                "one: an earlier push may have left files behind; ask its owner to push it by `playslot dataset push`"
            )
        found = HubRecord.of(seen.fingerprint, seen.episodes, seen.frames)
        warnings = tuple(line.replace(f"{partial}/", "") for line in seen.warnings)
        record = read_record(partial)
        if record is None or record.scheme != SCHEME:
            return found, False, warnings
        if found != record:
            raise HubError(
                f"{hub.name}: got {found.episodes} episodes, {found.frames} frames, fingerprint {found.fingerprint}, "
                f"expected {record.episodes}, {record.frames}, {record.fingerprint} as pushed: the data set was "
                "changed on the Hub by something else; ask its owner to push it again"
            )
    except (DataError, HubError):
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return found, True, warnings


def _finish(partial: Path, root: Path, result: PullResult, endpoint: str) -> None:
    """Note the origin, and put the folder in its place."""
    origin = {key: value for key, value in asdict(result).items() if key not in ("root", "why", "warnings")}
    origin |= {"endpoint": endpoint, "pulled": datetime.now(UTC).isoformat(timespec="seconds")}
    write_json(partial / LOCAL_RECORD, origin)
    if root.is_dir():
        root.rmdir()  # empty, or it would have been refused
    replace_dir(partial, root)
    for old in root.parent.iterdir():  # of commits that have been superseded
        if re.fullmatch(re.escape(f".{root.name}.pull-") + "[0-9a-f]{16}", old.name):
            shutil.rmtree(old, ignore_errors=True)


def pull_policy(repo_id: str, revision: str = "", cache: str | Path = "", token: str | None = None) -> Path:
    """Download a policy, unless that commit of it is in the cache, and return the model folder. With HF_HUB_OFFLINE=1 a
    branch or tag is the commit that it was when it was last pulled, which a line says. A CheckpointError where the
    repository holds none, a HubError for whatever the Hub says.
    """
    from huggingface_hub import is_offline_mode

    from playslot_rl.sharing.folder import CONFIG, FILES, RANGE, WEIGHTS

    home = cache_folder(cache) / "policies" / repo_id.replace("/", "--")
    if re.fullmatch("[0-9a-f]{40}", revision) and (home / revision).is_dir():
        return home / revision  # a commit never changes: no network is needed
    asked = revision or MAIN
    known = home / "refs" / asked.replace("/", "--")
    if is_offline_mode() and known.is_file() and (last := home / known.read_text()).is_dir():
        print(f"note: offline: {asked} of {repo_id} is {last.name[:12]}, as it was last pulled", file=sys.stderr)
        return last
    with open_repository(repo_id, home, token=token, writing=False, revision=revision, kind="model") as hub:
        commit = hub.commit_of(asked)

        def fetch(folder: Path) -> None:
            wanted = {path: file for path, file in hub.tree(commit).items() if path in (*FILES, RANGE)}
            for name in (CONFIG, WEIGHTS):
                if name not in wanted:
                    raise CheckpointError(f"{hub.name}: got no {name}, expected a PlaySlot policy: check the name")
            hub.download(wanted, commit, folder)
            shutil.rmtree(folder / ".cache", ignore_errors=True)

        made = build_once(home / commit, fetch)
        if asked != commit:
            write_bytes(known, commit.encode())
        return made
