"""What a command has left in a folder, less what is of the day: times, logs and locks."""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from playslot_rl.storage.checkpoints import source_commit

TIMES = re.compile(r"(^|_)(seconds|began|started|ended|time|used|pulled|created|rate_fps|steps_per_second)(_|$)")
"""Keys of JSON files whose values are times."""
OF_THE_DAY = ("command", "commit", "commits", "trained_at", "machine", "sittings")
"""The commit is unknown to a process that may open too few files to ask git."""
SPENT = re.compile(r"\b\d+(\.\d+)? ?(s|ms|min|h|seconds|minutes)\b")
PASSING = (".lock", ".log")
"""Names of a fingerprint's cache are made of times, too."""


def contents(root: Path, passing: Iterable[str] = ()) -> dict[str, str]:
    """Relative path -> digest of every file and folder.

    Args:
        root: the folder.
        passing: parts of names whose content is of the day; only that they are there counts.
    """
    found = {}
    for path in sorted(root.rglob("*")):
        name = str(path.relative_to(root))
        if "/logs/" in f"/{name}/" or "cache/fingerprints/" in name or path.suffix in PASSING:
            continue
        if path.is_dir():
            found[name] = "folder"
        elif any(part in name for part in passing):
            found[name] = "there"
        else:
            found[name] = hashlib.sha256(_content(path)).hexdigest()[:12]
    return found


def _content(path: Path) -> bytes:
    if path.suffix in (".json", ".jsonl"):
        lines = [path.read_text()] if path.suffix == ".json" else path.read_text().splitlines()
        return json.dumps([_timeless(json.loads(line)) for line in lines], sort_keys=True).encode()
    if path.suffix == ".parquet":  # its header names the day's fingerprint of the library that wrote it
        table = pq.ParquetFile(path).read()
        return repr((table.schema.remove_metadata(), table.to_pylist())).encode()
    if path.suffix in (".md", ".html"):
        text, commit = path.read_text(), _commit()
        return SPENT.sub("some time", text.replace(commit, "–") if commit else text).encode()
    return path.read_bytes()


@functools.cache
def _commit() -> str:
    """As reports show it; git is asked once, not for every report."""
    return source_commit()[:12]


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _timeless(inner) for key, inner in value.items() if not TIMES.search(key) and key not in OF_THE_DAY
        }
    if isinstance(value, list):
        return [_timeless(inner) for inner in value]
    return value
