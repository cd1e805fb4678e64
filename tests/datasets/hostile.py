"""Data sets that mean no good, or that nobody looked at: what is done to a sound one, by name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from damage import CAMERA, EPISODES, ROWS, edit_column, edit_json, put

Do = Callable[[Path], None]
INFO = "meta/info.json"
HUGE = 10**30
NAN, INFINITE = float("nan"), float("inf")


def info(**changes: Any) -> Do:
    return lambda root: edit_json(root, INFO, lambda content: content.update(changes))


def feature(name: str, **changes: Any) -> Do:
    return lambda root: edit_json(root, INFO, lambda content: content["features"][name].update(changes))


def another_feature(name: str, **values: Any) -> Do:
    made = {"dtype": "float32", "shape": [1], "names": None} | values
    return lambda root: edit_json(root, INFO, lambda content: content["features"].update({name: made}))


def raw(file: str, content: bytes) -> Do:
    def write(root: Path) -> None:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_bytes(content)

    return write


def episode(column: str, value: Any) -> Do:
    """Another value in every row of `meta/episodes`, whatever its type."""

    def write(root: Path) -> None:
        table = pq.ParquetFile(root / EPISODES).read()
        values = pa.array([value] * len(table))
        at = table.schema.get_field_index(column)
        table = table.append_column(column, values) if at < 0 else table.set_column(at, column, values)
        pq.write_table(table, root / EPISODES)

    return write


def column(name: str, change: Callable[[Any], Any]) -> Do:
    """Another column of rows, of another type."""

    def write(root: Path) -> None:
        table = pq.ParquetFile(root / ROWS).read()
        at = table.schema.get_field_index(name)
        table = table.set_column(at, name, change(table.column(name)))
        pq.write_table(table.replace_schema_metadata(None), root / ROWS)

    return write


def twice(name: str) -> Do:
    def write(root: Path) -> None:
        table = pq.ParquetFile(root / ROWS).read()
        pq.write_table(table.append_column(name, table.column(name)), root / ROWS)

    return write


def linked(file: str) -> Do:
    """A file of the set as a link to one beside it."""

    def write(root: Path) -> None:
        away = root.with_name("elsewhere") / Path(file).name
        away.parent.mkdir(exist_ok=True)
        shutil.move(root / file, away)
        (root / file).symlink_to(away)

    return write


def linked_folder(root: Path) -> None:
    shutil.move(root / "data", root.with_name("elsewhere"))
    (root / "data").symlink_to(root.with_name("elsewhere"))


def nested(place: str) -> Do:
    def write(root: Path) -> None:
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / ROWS, root / place)

    return write


def path_of_image(path: str) -> Do:
    return lambda root: edit_column(root, ROWS, CAMERA, lambda cells: cells[3].update(bytes=None, path=path))


def record(**changes: Any) -> Do:
    def write(root: Path) -> None:
        episodes = [{"seed": n} for n in range(3)]
        (root / "meta/playslot.json").write_text(json.dumps({"episodes": episodes} | changes))

    return write


def texts(values: Any) -> Any:
    return pa.array([str(value) for value in values.to_pylist()])


def with_null(values: Any) -> Any:
    cells = values.to_pylist()
    cells[4] = None
    return pa.array(cells, values.type)


def with_inner_null(values: Any) -> Any:
    return pa.array([[None, 0.0] if n == 4 else row for n, row in enumerate(values.to_pylist())])


TEMPLATE = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
METADATA: dict[str, Do] = {
    "fps NaN": info(fps=NAN),
    "fps infinite": info(fps=INFINITE),
    "fps below zero": info(fps=-1),
    "fps zero": info(fps=0),
    "fps huge": info(fps=HUGE),
    "fps a word": info(fps="ten"),
    "fps true": info(fps=True),
    "fps nothing": info(fps=None),
    "frames below zero": info(total_frames=-1),
    "frames huge": info(total_frames=HUGE),
    "frames a billion": info(total_frames=10**9),
    "frames a word": info(total_frames="15"),
    "episodes huge": info(total_episodes=HUGE),
    "episodes a trillion": info(total_episodes=10**12),
    "episodes a half": info(total_episodes=2.5),
    "tasks infinite": info(total_tasks=INFINITE),
    "chunks of zero": info(chunks_size=0),
    "chunks below zero": info(chunks_size=-1000),
    "sizes NaN": info(data_files_size_in_mb=NAN),
    "sizes below zero": info(data_files_size_in_mb=-1),
    "sizes a list": info(video_files_size_in_mb=[1]),
    "splits a word": info(splits="train"),
    "no features": info(features={}),
    "features a list": info(features=[1]),
    "a feature a word": lambda root: edit_json(root, INFO, lambda c: c["features"].update(action="float32")),
    "format a number": info(codebase_version=3),
    "width of ten digits": info(data_path="data/chunk-{chunk_index:>9999999999}/file-{file_index}.parquet"),
    "zeros of ten digits": info(data_path="data/chunk-{chunk_index:09999999999d}/file-{file_index}.parquet"),
    "attributes": info(data_path="data/{chunk_index.__class__}/{file_index}.parquet"),
    "an index": info(data_path="data/{chunk_index[0]}/{file_index}.parquet"),
    "a conversion": info(data_path="data/{chunk_index!r}/{file_index}.parquet"),
    "an unknown field": info(data_path="data/{secret}/{file_index}.parquet"),
    "an open brace": info(data_path="data/{chunk_index/{file_index}.parquet"),
    "no field": info(data_path="data/chunk-000/file-000.parquet"),
    "a path outside": info(data_path=f"../elsewhere/{TEMPLATE}"),
    "a path from the root": info(data_path=f"/{TEMPLATE}"),
    "a path with backslashes": info(data_path=TEMPLATE.replace("/", "\\")),
    "a path of a million": info(data_path="x" * 10**6 + TEMPLATE),
    "a path that is a number": info(data_path=7),
    "a video path outside": info(video_path="../{video_key}/{chunk_index}/{file_index}.mp4"),
    "a video path with attributes": info(video_path="videos/{video_key.__class__}/{chunk_index}/{file_index}.mp4"),
    "shape below zero": feature("action", shape=[-1]),
    "shape zero": feature("action", shape=[0]),
    "shape huge": feature("action", shape=[HUGE]),
    "shape of billions": feature("action", shape=[10**5, 10**5]),
    "shape a half": feature("action", shape=[2.5]),
    "shape words": feature("action", shape=["2"]),
    "shape a number": feature("action", shape=2),
    "shape of a hundred axes": feature("action", shape=[1] * 100),
    "another shape": feature("action", shape=[3]),
    "another shape of the index": feature("index", shape=[2]),
    "index a float": feature("index", dtype="float32"),
    "time a text": feature("timestamp", dtype="string"),
    "a picture of a line": feature(CAMERA, shape=[32]),
    "a picture of gigapixels": feature(CAMERA, shape=[100_000, 100_000, 3]),
    "an unknown type": feature("action", dtype="banana"),
    "a type with a line break": feature("action", dtype="float32\nsound"),
    "no type": feature("action", dtype=None),
    "names a word": feature("action", names="xy"),
    "info a word": feature(CAMERA, info="rgb"),
    "info NaN": feature(CAMERA, info={"video.fps": NAN}),
    "a feature with a slash": another_feature("../../outside"),
    "a feature with a backslash": another_feature("..\\..\\outside"),
    "a camera with a slash": another_feature("../../outside", dtype="video", shape=[32, 32, 3]),
    "a feature with a line break": another_feature("a\nb"),
    "a feature without rows": another_feature("ghost"),
    "no JSON": raw(INFO, b"\x00\xff\xfe"),
    "half a character": raw(INFO, b'{"codebase_version": "v3.0", "features": {"\\ud800": 1}}'),
    "lists in lists": raw(INFO, b"[" * 200_000),
    "a number of digits": raw(INFO, b'{"fps": ' + b"1" * 10_000 + b"}"),
    "a list": raw(INFO, b"[1, 2]"),
    "statistics a list": raw("meta/stats.json", b"[1, 2]"),
    "statistics in lists": raw("meta/stats.json", b"[" * 200_000),
    "statistics of words": raw("meta/stats.json", b'{"action": {"mean": ["a", [1, 2]]}}'),
    "tasks no parquet": raw("meta/tasks.parquet", b"PAR1" + b"\xff" * 100 + b"PAR1"),
    "task numbers below zero": lambda root: pq.write_table(
        pa.table({"task_index": [-1], "task": ["push"]}), root / "meta/tasks.parquet"
    ),
    "task numbers words": lambda root: pq.write_table(
        pa.table({"task_index": ["x"], "task": ["push"]}), root / "meta/tasks.parquet"
    ),
    "episodes no parquet": raw(EPISODES, b"PAR1" + b"\xff" * 100 + b"PAR1"),
    "rows no parquet": raw(ROWS, b"PAR1" + b"\xff" * 100 + b"PAR1"),
    "length below zero": episode("length", -1),
    "length huge": episode("length", 2**62),
    "length infinite": episode("length", INFINITE),
    "length a word": episode("length", "five"),
    "episode_index infinite": episode("episode_index", INFINITE),
    "episode_index huge": episode("episode_index", 2**62),
    "tasks a number": episode("tasks", 5),
    "file_index huge": episode("data/file_index", 2**62),
    "file_index below zero": episode("data/file_index", -1),
    "file_index a word": episode("data/file_index", "../../x"),
    "file_index a half": episode("data/file_index", 0.5),
    "file_index stale": episode("data/file_index", 1),
    "place of metadata a word": episode("meta/episodes/chunk_index", "x"),
    "from a word": episode("dataset_from_index", "x"),
    "a statistic of words": episode("stats/action/mean", ["a", "b"]),
    "a statistic of another shape": episode("stats/action/mean", [[1.0, 2.0, 3.0]]),
    "a statistic that is NaN": episode("stats/action/mean", [NAN, NAN]),
    "a record of words": record(episodes=["a", "b", "c"]),
    "a record's spec a word": record(spec="x"),
    "a record's success a word": record(success_rate="all"),
    "a record's skip a word": record(spec={"env": {"frame_skip": "x"}}),
    "a record NaN": record(note=NAN),
}
"""Numbers, names and paths of `meta/`."""

CONTENT: dict[str, Do] = {
    "an image path outside": path_of_image("../../../etc/hostname"),
    "an image path from the root": path_of_image("/etc/hostname"),
    "images that are texts": column(CAMERA, lambda values: pa.array(["x"] * len(values))),
    "actions that are texts": column("action", texts),
    "actions that are records": column("action", lambda values: pa.array([{"x": 1}] * len(values))),
    "actions of lists in lists": column("action", lambda values: pa.array([[[1.0, 2.0]]] * len(values))),
    "actions of other lengths": column("action", lambda values: pa.array([[1.0] * (n % 3) for n in range(15)])),
    "an action missing": column("action", with_null),
    "a part of an action missing": column("action", with_inner_null),
    "an action NaN": lambda root: edit_column(root, ROWS, "action", put(3, [NAN, 0.0])),
    "index as text": column("index", texts),
    "index as float": column("index", lambda values: values.cast(pa.float64())),
    "episode_index as text": column("episode_index", texts),
    "task_index as float": column("task_index", lambda values: values.cast(pa.float32())),
    "time as text": column("timestamp", texts),
    "time as a date": column("timestamp", lambda values: pa.array(np.arange(len(values)), pa.timestamp("s"))),
    "time as decimals": column("timestamp", lambda values: pa.array(range(len(values)), pa.decimal128(9))),
    "a column twice": twice("action"),
    "rows linked": linked(ROWS),
    "metadata linked": linked(INFO),
    "statistics linked": linked("meta/stats.json"),
    "episodes linked": linked(EPISODES),
    "tasks linked": linked("meta/tasks.parquet"),
    "a folder linked": linked_folder,
    "rows nested deeper": nested("data/chunk-000/more/file-001.parquet"),
    "rows not nested": nested("data/file-001.parquet"),
    "metadata nested deeper": nested("meta/episodes/chunk-000/more/file-001.parquet"),
    "a hidden file of rows": nested("data/chunk-000/._file-001.parquet"),
}  # fmt: skip
"""Columns of other types, links, and files where none is looked for."""

HARMLESS = {"a record's spec a word", "a record's success a word", "a record's skip a word", "a record NaN"}
"""What says nothing about a row or a frame, and may be left unread."""
