"""Small LeRobot v3.0 data sets, written without LeRobot, whose import costs seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from playslot_rl.datasets.statistics import of_numbers

FPS = 10
NOTE = {
    "spec": {
        "policy": "expert",
        "episodes": 3,
        "steps": 4,
        "seed": 7,
        "noise": 0.2,
        "storage": "image",
        "env": {"name": "button_press", "frame_skip": 5},
        "render": {"quality": "fast"},
    },
    "success_rate": 2 / 3,
    "versions": {"mujoco": "3.3.0"},
    "episodes": [],
}


def write_small(
    root: Path, *, lengths: tuple[int, ...] = (5, 5, 5), shards: int = 2, seed: int = 0, wide: int = 0,
    version: str = "v3.0", ours: bool = True,
) -> Path:  # fmt: skip
    """A data set of `shards` data files.

    Args:
        wide: random bytes in the first row of the last file, to make it as long as a transfer needs to be cut.
        ours: with the note of our collectors.
    """
    generator = np.random.default_rng(seed)
    files = np.arange(len(lengths)) * shards // len(lengths)
    starts = np.cumsum([0, *lengths[:-1]])
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": [2], "names": ["x", "y"]},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None}
           for name in ("frame_index", "episode_index", "index", "task_index")},
    }  # fmt: skip
    if wide:
        features["noise"] = {"dtype": "string", "shape": [1], "names": None}
    for file in range(shards):
        here = np.flatnonzero(files == file)
        rows = _rows(here, lengths, starts, generator)
        if wide:
            rows["noise"] = [generator.bytes(wide // 2).hex() if file == shards - 1 else ""]
            rows["noise"] += [""] * (len(rows["index"]) - 1)
        types = {"action": pa.list_(pa.float32(), 2), "timestamp": pa.float32()}
        table = pa.table({name: pa.array(values, types.get(name)) for name, values in rows.items()})
        _write(root / f"data/chunk-000/file-{file:03d}.parquet", table)
    _write_metadata(root, features, lengths, starts, files, version)
    if ours:
        (root / "meta/playslot.json").write_text(json.dumps(NOTE | {"episodes": [{"seed": None}] * len(lengths)}))
    return root


def _rows(here: Any, lengths: tuple[int, ...], starts: Any, generator: np.random.Generator) -> dict[str, list[Any]]:
    """Rows of some episodes; all but the first are solved at their end."""
    steps = [(int(episode), t) for episode in here for t in range(lengths[episode])]
    return {
        "action": generator.normal(size=(len(steps), 2)).astype(np.float32).tolist(),
        "next.success": [episode > 0 and t == lengths[episode] - 1 for episode, t in steps],
        "timestamp": [t / FPS for _, t in steps],
        "frame_index": [t for _, t in steps],
        "episode_index": [episode for episode, _ in steps],
        "index": [int(starts[episode]) + t for episode, t in steps],
        "task_index": [0] * len(steps),
    }


def _write_metadata(
    root: Path, features: dict[str, Any], lengths: tuple[int, ...], starts: Any, files: Any, version: str
) -> None:
    episodes = {
        "episode_index": list(range(len(lengths))),
        "tasks": [["press | the “button”"]] * len(lengths),
        "length": list(lengths),
        "data/chunk_index": [0] * len(lengths),
        "data/file_index": files.tolist(),
        "dataset_from_index": starts.tolist(),
        "dataset_to_index": (starts + lengths).tolist(),
        "meta/episodes/chunk_index": [0] * len(lengths),
        "meta/episodes/file_index": [0] * len(lengths),
    }
    _write(root / "meta/episodes/chunk-000/file-000.parquet", pa.table(episodes))
    _write_statistics(root, features)
    tasks = pa.table({"task_index": [0], "__index_level_0__": ["press | the “button”"]})
    _write(root / "meta/tasks.parquet", tasks)
    info = {
        "codebase_version": version, "robot_type": "sawyer", "total_episodes": len(lengths),
        "total_frames": sum(lengths), "total_tasks": 1, "chunks_size": 1000, "fps": FPS, "splits": {},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        "features": features,
    }  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(info))


def _write_statistics(root: Path, features: dict[str, Any]) -> None:
    """Of all rows; those of each episode may be missing."""
    tables = [pq.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))]
    stats = {}
    for name, feature in features.items():
        if feature["dtype"] != "string":
            values = np.concatenate([np.asarray(table.column(name).to_pylist()) for table in tables])
            stats[name] = {key: value.tolist() for key, value in of_numbers(values).items()}
    (root / "meta/stats.json").write_text(json.dumps(stats))


def _write(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="none", use_dictionary=False)


def contents(root: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
