"""Ways to break a data set, and plain LeRobot as the judge of a whole one."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ROWS = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
CAMERA = "observation.images.top"


def edit_column(root: Path, file: str, column: str, change: Callable[[list[Any]], None]) -> None:
    """Change values of a parquet column."""
    table = pq.ParquetFile(root / file).read()
    values = table.column(column).to_pylist()
    change(values)
    field = table.schema.field(column)
    table = table.set_column(table.schema.get_field_index(column), field, pa.array(values, field.type))
    pq.write_table(table, root / file)


def put(number: int, value: Any) -> Callable[[list[Any]], None]:
    """Change one value."""

    def change(values: list[Any]) -> None:
        values[number] = value

    return change


def keep_rows(root: Path, file: str, rows: int) -> None:
    """Drop the rows after the first ones."""
    pq.write_table(pq.ParquetFile(root / file).read().slice(0, rows), root / file)


def edit_json(root: Path, file: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a JSON file."""
    content = json.loads((root / file).read_text())
    change(content)
    (root / file).write_text(json.dumps(content))


def truncate(path: Path, share: float = 0.5) -> None:
    """Cut a file off."""
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def load(root: Path, **options: Any) -> Any:
    """Plain LeRobot."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("anything/at_all", root=root, video_backend="pyav", **options)


def frames_of(root: Path, camera: str = CAMERA) -> np.ndarray:
    """All frames as plain LeRobot reads them, (F, 3, H, W)."""
    dataset = load(root)
    return np.stack([dataset[i][camera].numpy() for i in range(len(dataset))])


def killed_while(write: Callable[[Callable[[], None]], None], saved: int) -> None:
    """Run `write(tick)` in another process and kill it with SIGKILL once it has ticked `saved` times."""
    context = multiprocessing.get_context("fork")
    reader, writer = context.Pipe(duplex=False)

    def body() -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the encoders' notes
        write(lambda: writer.send(1))

    process = context.Process(target=body)
    process.start()
    for _ in range(saved):
        assert reader.poll(60), "the writer died by itself"
        reader.recv()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL


def add_episodes(dataset: Any, lengths: tuple[int, ...], tick: Callable[[], None], size: int = 32) -> None:
    """Record episodes of noise, without an end: after the last one the writer goes on with another that never ends."""
    generator = np.random.default_rng(1)
    cameras = [name for name in dataset.features if name.startswith("observation.images")]
    for length in (*lengths, 10**9):
        for t in range(length):
            image = generator.integers(0, 256, (size, size, 3), np.uint8)
            row: dict[str, Any] = dict.fromkeys(cameras, image)
            dataset.add_frame(row | {"action": np.array([t, -t], np.float32), "task": "pull"})
            if length == 10**9 and t == 3:
                tick()
        dataset.save_episode()
        tick()
