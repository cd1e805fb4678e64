"""A data set or a policy to the Hub: checked first, sent in one commit, compared with what the Hub then lists.

A card is made anew by every push unless somebody wrote one by hand, in the folder or on the Hub.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from playslot_rl import keys
from playslot_rl.data.metadata import read_record
from playslot_rl.datasets.info import DatasetSummary, info
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError, HubError
from playslot_rl.hub.layout import CARD_NAME, REMOTE_RECORD, HubRecord, is_data, local_files
from playslot_rl.hub.session import MAIN, Pushed, few, open_repository, send
from playslot_rl.sharing.card import MARK as POLICY_MARK
from playslot_rl.sharing.card import facts_table, front_matter
from playslot_rl.sharing.folder import files_of, require_whole

MARK = "<!-- made by `playslot dataset push`; remove this line to keep your own text -->"
"""A card with this line was made here and not edited by hand."""
TASKS_SHOWN = 8
USE = """\
## Use it

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{repo_id}")
```
"""


def make_card(data: DatasetSummary, repo_id: str, fingerprint: str) -> str:
    """The card as Markdown with a YAML header."""
    note = read_record(Path(data.root)) or {}
    made = _made(note)
    header = {
        # Ours are free, as this package is; of others' data we know nothing.
        "license": "apache-2.0" if made else "unknown",
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "playslot_rl", *([made["environment"]] if "environment" in made else [])],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    task = f" of the task “{next(iter(data.tasks))}”" if len(data.tasks) == 1 else ""
    lines = [
        front_matter(header, MARK),
        "",
        f"# {repo_id.partition('/')[2]}",
        "",
        f"{data.episodes} episodes{task}, {data.frames} frames, in LeRobot's format {data.format}.",
        "",
        facts_table(_description(data, note, fingerprint)),
        "",
    ]
    if made:
        lines += ["## How it was made", "", "Recorded by `playslot collect` of playslot_rl.", "", facts_table(made), ""]
    return "\n".join([*lines, USE.format(repo_id=repo_id)])


def _made(note: dict[str, Any]) -> dict[str, str]:
    """How it was recorded: settings of the collection, then versions."""
    spec = note.get("spec") or {}
    env = spec.get("env") or {}
    rows = {
        "environment": " ".join(filter(None, (env.get("name"), env.get("task")))),
        "policy": spec.get("policy"),
        "noise on the expert's actions": spec.get("noise"),
        "agent steps an episode": spec.get("steps"),
        "environment steps an agent step": env.get("frame_skip"),
        "base seed": spec.get("seed"),
        "frames stored as": spec.get("storage"),
        "rendering": (spec.get("render") or {}).get("quality"),
        "versions": ", ".join(f"{name} {number}" for name, number in (note.get("versions") or {}).items()),
    }
    return {name: str(value) for name, value in rows.items() if value not in (None, "")}


def _description(data: DatasetSummary, note: dict[str, Any], fingerprint: str) -> dict[str, str]:
    tasks = list(data.tasks)
    more = f"; and {len(tasks) - TASKS_SHOWN} more" if len(tasks) > TASKS_SHOWN else ""
    cameras = {name: kind.split()[1] for name, kind in data.features.items() if kind.startswith(("image ", "video "))}
    action = data.features.get(keys.FEATURE_ACTION, "").split()
    skip = ((note.get("spec") or {}).get("env") or {}).get("frame_skip")
    success = note.get("success_rate", data.success_rate)
    return {
        "task": "; ".join(tasks[:TASKS_SHOWN]) + more if tasks else "not named",
        "camera": ", ".join(f"`{name}` {size}" for name, size in cameras.items()) or "none",
        "frames a second": f"{data.fps:g}",
        "control rate": f"{data.fps * skip:g} Hz" if skip else "not recorded",
        "episodes": str(data.episodes),
        "frames": str(data.frames),
        "success": "not recorded" if success is None else f"{100 * success:.1f} % of the episodes",
        "action": f"{action[1]} numbers" if len(action) > 1 else "none",
        "robot": data.robot or "not named",
        "fingerprint": f"`{fingerprint}`",
    }


_VERSION = re.compile(r"v?\d+(\.\d+)*")


@dataclass(frozen=True)
class PushResult(Pushed):
    record: HubRecord
    left: tuple[str, ...]

    def lines(self) -> list[str]:
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
    """Upload a LeRobot data set. An interrupted push changes nothing there; the same command carries on. A DataError
    where it is not whole, a HubError for whatever the Hub says.

    Args:
        branch: made from main if it is not there; None means main. The version tag moves with main only.
        tag: one more tag for the commit; never moved.
        token: None takes HF_TOKEN or what `hf auth login` stored.
    """
    root = Path(root).expanduser()
    result = verify(root)  # all of it: others will build on the data set
    if not result.ok:
        more = f" (and {len(result.errors) - 1} more)" if len(result.errors) > 1 else ""
        raise DataError(f"{result.errors[0]}{more}; run `playslot dataset verify {root}` for all of it, then `repair`")
    record = HubRecord.of(result.fingerprint, result.episodes, result.frames)
    summary = info(root)
    target = branch or MAIN
    _check_names(target, tag, summary.format)
    paths, left = local_files(root)
    with open_repository(repo_id, root, token=token, writing=True, revision=target) as hub:
        files: dict[str, Path | bytes] = {path: root / path for path in paths}
        files[REMOTE_RECORD] = (json.dumps(asdict(record), indent=2) + "\n").encode()
        files[CARD_NAME] = make_card(summary, hub.name, record.fingerprint).encode()
        message = f"{record.episodes} episodes, {record.frames} frames, fingerprint {record.fingerprint}"
        sent = send(
            hub, root, files, mark=MARK, message=message, private=private, branch=target, tag=tag,
            version=summary.format if target == MAIN else "", owned=is_data,
        )  # fmt: skip
    return PushResult(**vars(sent), record=record, left=tuple(left))


def _check_names(branch: str, tag: str | None, version: str) -> None:
    """Refuse branches and tags that LeRobot would take for a format version."""
    more = f"; {version} is set by every push to main"
    for key, name, cure in (("branch", "" if branch == MAIN else branch, ""), ("tag", tag or "", more)):
        if _VERSION.fullmatch(name):
            raise HubError(
                f"{key}={name}: got the name of a format version, expected another: LeRobot would load it as that{cure}"
            )


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
    `push`, with a CheckpointError where the folder is not whole.
    """
    config = require_whole(folder)
    files: dict[str, Path | bytes] = {name: folder / name for name in files_of(config)}
    message = f"PlaySlot policy, weights {config.fingerprint}"
    target = branch or MAIN
    with open_repository(repo_id, folder, token=token, writing=True, revision=target, kind="model") as hub:
        sent = send(hub, folder, files, mark=POLICY_MARK, message=message, private=private, branch=target, tag=tag)
    return PolicyPushResult(**vars(sent), fingerprint=config.fingerprint)
