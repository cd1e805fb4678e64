"""What a data set holds, in a few lines; reads no frames."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl import keys
from playslot_rl.data.contents import Contents
from playslot_rl.data.metadata import REQUIRED, read_record, robot_of
from playslot_rl.datasets.verify import require_sound

MEBIBYTE = 2**20


@dataclass(frozen=True)
class DatasetSummary:
    """Summary of a data set.

    Attributes:
        format: LeRobot's version of it.
        lengths: shortest, mean and longest episode, frames.
        tasks: words -> episodes.
        features: name -> type and shape; without those that every data set has.
        bytes: of rows, videos and metadata.
        success_rate: share of episodes with a true `next.success`; None where there is no such feature.
        seeds: smallest and largest, or None.
        source: what our own record says about its making, or None.
    """

    root: str
    format: str
    robot: str
    fps: float
    episodes: int
    frames: int
    lengths: tuple[int, float, int]
    tasks: dict[str, int]
    features: dict[str, str]
    bytes: dict[str, int]
    success_rate: float | None
    seeds: tuple[int, int] | None
    source: dict[str, Any] | None

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2)

    def facts(self) -> list[tuple[str, str]]:
        shortest, mean, longest = self.lengths
        length = f"{shortest}" if shortest == longest else f"{shortest} to {longest}, mean {mean:.1f}"
        seconds = self.frames / self.fps
        sizes = ", ".join(f"{name} {size / MEBIBYTE:.1f} MiB" for name, size in self.bytes.items() if size)
        found = [
            ("episodes", f"{self.episodes}, {length} frames each"),
            ("frames", f"{self.frames} at {self.fps:g} fps ({seconds:.0f} s)"),
            *(("task", f"{words!r} ({count} episodes)") for words, count in self.tasks.items()),
            ("size", sizes),
        ]
        if self.success_rate is not None:
            found.append(("success", f"{100 * self.success_rate:.1f} % of the episodes"))
        if self.seeds is not None:
            found.append(("seeds", f"{self.seeds[0]} to {self.seeds[1]}"))
        if self.source is not None:
            found.append(("made by", ", ".join(f"{name} {value}" for name, value in self.source.items())))
        return found

    def lines(self) -> list[str]:
        head = f"{self.root}: LeRobot {self.format}, robot {self.robot or 'not stated'}"
        found = [head, *(f"{name:<8}  {value}" for name, value in self.facts())]
        width = max(map(len, self.features))
        return [*found, "features", *(f"  {name:<{width}}  {kind}" for name, kind in self.features.items())]


def info(root: str | Path) -> DatasetSummary:
    """Summarise the data set at `root`; a DataError where it cannot be read, or rows and metadata do not agree."""
    contents = require_sound(root)
    lengths = [span.length for span in contents.spans]
    sizes = {}
    for name, folder in (("rows", "data"), ("videos", "videos"), ("metadata", "meta")):
        sizes[name] = sum(path.stat().st_size for path in (contents.root / folder).rglob("*") if path.is_file())
    solved, seeds = contents.numbers(keys.FEATURE_SUCCESS), contents.numbers(keys.FEATURE_SEED)
    success_rate = None
    if solved is not None:
        success_rate = float(np.mean([bool(solved[span.start : span.stop].any()) for span in contents.spans]))
    return DatasetSummary(
        root=str(root),
        format=str(contents.info["codebase_version"]),
        robot=robot_of(contents.info),
        fps=contents.fps,
        episodes=len(lengths),
        frames=contents.rows,
        lengths=(min(lengths), float(np.mean(lengths)), max(lengths)),
        tasks=dict(Counter(words for episode in contents.episodes for words in episode.tasks)),
        features={name: _kind(f) for name, f in contents.features.items() if name not in REQUIRED},
        bytes=sizes,
        success_rate=success_rate,
        seeds=None if seeds is None else (int(seeds.min()), int(seeds.max())),
        source=_source(contents),
    )


def _kind(feature: Mapping[str, Any]) -> str:
    shape = "x".join(map(str, feature["shape"]))
    codec = (feature.get("info") or {}).get("video.codec")
    return f"{feature['dtype']} {shape}{f' ({codec})' if codec else ''}"


def _source(contents: Contents) -> dict[str, Any] | None:
    record = read_record(contents.root)
    if record is None:
        return None
    if "made_by" in record:
        names = "+".join(str(source.get("name")) for source in record.get("sources") or [])
        return {"command": record["made_by"], "of": names}
    spec = record.get("spec") or {}
    env = spec.get("env") or {}
    task = "_".join(filter(None, (env.get("name"), env.get("task"))))
    return {"policy": spec.get("policy"), "task": task or None, "seed": spec.get("seed"), "noise": spec.get("noise")}
