"""Small collections for the tests of faults, and what a whole one has."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet

from playslot_rl.collectors import collect
from playslot_rl.collectors.journal import CollectionSpec, Journal, journal_path
from playslot_rl.config import ExperimentConfig, from_dict

STEPS = 3
SMALL: dict[str, Any] = {
    "env": {"image_size": 32, "warmup_steps": 1},
    "render": {"supersample": 1},
    "logging": {"progress": False},
}


def config(**changes: Any) -> ExperimentConfig:
    return from_dict(ExperimentConfig, {**SMALL, **changes})


def spec_of(episodes: int) -> CollectionSpec:
    return CollectionSpec.make(config(), "random", episodes, STEPS, 0)


def small(out: Path, episodes: int = 2, **changes: Any) -> Path:
    return collect(config(**changes), "random", episodes, STEPS, out, seed=0, workers=1)


def assert_whole(out: Path, episodes: int, reference: list[Any] | None = None) -> None:
    """Every seed once and in order, every row there, frames as an undisturbed process records them; nothing beside."""
    columns = ["index", "episode_index", "frame_index", "seed", "observation.images.front"]
    rows = [
        row
        for file in sorted((out / "data").rglob("*.parquet"))
        for row in parquet.read_table(file, columns=columns).to_pylist()
    ]
    each = STEPS + 1
    assert [row["index"] for row in rows] == list(range(episodes * each))
    assert [row["seed"] for row in rows] == [i for i in range(episodes) for _ in range(each)]
    assert [row["episode_index"] for row in rows] == [i for i in range(episodes) for _ in range(each)]
    assert [row["frame_index"] for row in rows] == list(range(each)) * episodes
    record_file = json.loads((out / "meta" / "playslot.json").read_text())
    assert [e["seed"] for e in record_file["episodes"]] == list(range(episodes))
    assert json.loads((out / "meta" / "info.json").read_text())["total_episodes"] == episodes
    assert not journal_path(out).exists()
    assert not list(out.parent.glob(f".{out.name}.tmp-*"))
    for index, images in enumerate(reference or []):
        assert [row["observation.images.front"]["bytes"] for row in rows[index * each : (index + 1) * each]] == images


def begin(recorded: Path, out: Path, without: int | None = None) -> Journal:
    """A journal of three episodes for `out`, one of them missing."""
    shutil.copytree(recorded, journal_path(out))
    journal = Journal(journal_path(out), spec_of(3))
    if without is not None:
        journal.path(without).unlink()
    return journal
