"""The data set card: what the Hub shows about a data set, and LeRobot's tags by which it is found.

It is made anew by every push unless somebody wrote one by hand, in the data set's folder or on the Hub.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import yaml

from playslot_rl import keys
from playslot_rl.data.contents import Contents, stated_size
from playslot_rl.datasets.info import success_rate
from playslot_rl.hub.record import HubRecord
from playslot_rl.visualization.markdown import table

MARK = "<!-- made by `playslot dataset push`; remove this line to keep your own text -->"
META_NAME = "meta/playslot.json"
"""Settings and outcome of a recorded data set; written by the collectors."""

TASKS_SHOWN = 8


@dataclass(frozen=True)
class CardFacts:
    """What a card says.

    Attributes:
        tasks: in words.
        cameras: name, height and width of each.
        fps: stored frames a second.
        control_hz: environment steps a second; None if not recorded.
        success: share of episodes that solved the task, 0 to 1; None if not recorded.
        made: how it was recorded, name to text; empty if not by our collectors.
    """

    tasks: tuple[str, ...]
    cameras: tuple[tuple[str, int, int], ...]
    fps: float
    control_hz: float | None
    success: float | None
    made: dict[str, str]


def is_ours(card: str) -> bool:
    """Whether a card was made here and not edited by hand."""
    return MARK in card


def facts_of(files: Contents) -> CardFacts:
    """Read the facts from a checked data set and from what the collectors noted."""
    path = files.root / META_NAME
    note: dict[str, Any] = {}
    if path.is_file():
        loaded = json.loads(path.read_text())
        note = loaded if isinstance(loaded, dict) else {}
    spec = note.get("spec") if isinstance(note.get("spec"), dict) else {}
    assert isinstance(spec, dict)
    env = spec.get("env") or {}
    cameras = tuple((name, *stated_size(files.features[name])) for name in files.cameras)
    skip = env.get("frame_skip")
    success = note.get("success_rate")
    return CardFacts(
        tasks=_tasks(files),
        cameras=cameras,
        fps=files.fps,
        control_hz=files.fps * skip if skip else None,
        success=float(success) if success is not None else success_rate(files),
        made=_made(spec, env, note.get("versions") or {}),
    )


def _tasks(files: Contents) -> tuple[str, ...]:
    return tuple(dict.fromkeys(task for episode in files.episodes for task in episode.tasks if task))


def _made(spec: dict[str, Any], env: dict[str, Any], versions: dict[str, Any]) -> dict[str, str]:
    """How it was recorded: settings of the collection, then versions."""
    rows = {
        "environment": env.get("name"),
        "policy": spec.get("policy"),
        "noise on the expert's actions": spec.get("noise"),
        "agent steps an episode": spec.get("steps"),
        "environment steps an agent step": env.get("frame_skip"),
        "base seed": spec.get("seed"),
        "frames stored as": spec.get("storage"),
        "rendering": (spec.get("render") or {}).get("quality"),
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
    }
    return {name: str(value) for name, value in rows.items() if value not in (None, "")}


def make_card(files: Contents, repo_id: str, record: HubRecord) -> str:
    """The card as Markdown with a YAML header.

    Args:
        files: a checked data set.
        repo_id: `user/name`.
        record: fingerprint and counts.
    """
    facts = facts_of(files)
    header = {
        # Ours are free, as this package is; of others' data we know nothing.
        "license": "apache-2.0" if facts.made else "unknown",
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "playslot_rl", *([facts.made["environment"]] if "environment" in facts.made else [])],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    lines = ["---", yaml.safe_dump(header, sort_keys=False, allow_unicode=True).rstrip(), "---", "", MARK, ""]
    lines += [f"# {repo_id.partition('/')[2]}", "", _summary(files, facts), ""]
    lines += _table(_description(files, facts, record))
    if facts.made:
        lines += ["## How it was made", "", "Recorded by `playslot collect` of playslot_rl.", "", *_table(facts.made)]
    lines += [
        "## Use it",
        "",
        "```python",
        "from lerobot.datasets.lerobot_dataset import LeRobotDataset",
        "",
        f'dataset = LeRobotDataset("{repo_id}")',
        "```",
        "",
    ]
    return "\n".join(lines)


def _summary(files: Contents, facts: CardFacts) -> str:
    task = f" of the task “{facts.tasks[0]}”" if len(facts.tasks) == 1 else ""
    return f"{len(files.episodes)} episodes{task}, {files.rows} frames, in LeRobot's format {_version(files)}."


def _version(files: Contents) -> str:
    return str(files.info["codebase_version"])


def _description(files: Contents, facts: CardFacts, record: HubRecord) -> dict[str, str]:
    features = files.info["features"]
    more = f"; and {len(facts.tasks) - TASKS_SHOWN} more" if len(facts.tasks) > TASKS_SHOWN else ""
    action = features.get(keys.FEATURE_ACTION, {}).get("shape") or []
    rows = {
        "task": "; ".join(facts.tasks[:TASKS_SHOWN]) + more if facts.tasks else "not named",
        "camera": ", ".join(f"`{name}` {height} x {width}" for name, height, width in facts.cameras) or "none",
        "frames a second": f"{facts.fps:g}",
        "control rate": f"{facts.control_hz:g} Hz" if facts.control_hz else "not recorded",
        "episodes": str(len(files.episodes)),
        "frames": str(files.rows),
        "success": "not recorded" if facts.success is None else f"{100 * facts.success:.1f} % of the episodes",
        "action": f"{action[0]} numbers" if action else "none",
        "robot": str(files.info.get("robot_type") or "not named"),
        "fingerprint": f"`{record.fingerprint}`",
    }
    return rows


def _table(rows: dict[str, str]) -> list[str]:
    return [table(("", ""), rows.items()), ""]
