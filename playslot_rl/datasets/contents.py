"""What the files of a LeRobot v3.0 data set hold, read as far as they can be read.

Shapes: F rows (frames), E episodes.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.datasets.problems import Problems
from playslot_rl.errors import DataError

INFO_NAME: Final = "meta/info.json"
STATS_NAME: Final = "meta/stats.json"
TASKS_NAME: Final = "meta/tasks.parquet"
RECORD_NAME: Final = "meta/playslot.json"
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACE: Final = ("index", "episode_index", "task_index")
"""Columns that say where a row stands in its data set: they change when data sets are merged or split."""
REQUIRED: Final = ("timestamp", "frame_index", *PLACE)

Array = npt.NDArray[Any]
Stats = dict[str, dict[str, Array]]


@dataclass(frozen=True)
class Episode:
    """One row of `meta/episodes`.

    Attributes:
        index: `episode_index`.
        length: frames.
        tasks: in words.
        row: all its values but the statistics.
        stats: feature -> statistic -> array, float64.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    row: dict[str, Any]
    stats: Stats


@dataclass(frozen=True)
class Span:
    """Rows `start` to `stop` (exclusive) with one `episode_index`, in the data file number `file`."""

    index: int
    start: int
    stop: int
    file: int

    @property
    def length(self) -> int:
        """Rows."""
        return self.stop - self.start


@dataclass(frozen=True)
class Contents:
    """A data set as its files tell it.

    Attributes:
        root: its folder.
        info: `meta/info.json`.
        episodes: the readable ones, by index.
        tasks: `task_index` -> words.
        data_files: readable parquet files of rows, in order.
        file_rows: rows of each.
        columns: every feature that is no camera, (F, ...), rows in the order of the files; numbers, or objects.
    """

    root: Path
    info: dict[str, Any]
    episodes: list[Episode]
    tasks: dict[int, str]
    data_files: list[Path]
    file_rows: list[int]
    columns: dict[str, Array] = field(repr=False)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """Features by name."""
        features: dict[str, dict[str, Any]] = self.info["features"]
        return features

    @property
    def fps(self) -> float:
        """Frames a second."""
        return float(self.info["fps"])

    @property
    def rows(self) -> int:
        """F: rows that are there, whatever `meta/info.json` says."""
        return sum(self.file_rows)

    @property
    def images(self) -> list[str]:
        """Features whose frames are in the parquet files."""
        return [name for name, feature in self.features.items() if feature["dtype"] == "image"]

    @property
    def videos(self) -> list[str]:
        """Features whose frames are in mp4 files."""
        return [name for name, feature in self.features.items() if feature["dtype"] == "video"]

    @cached_property
    def spans(self) -> list[Span]:
        """Runs of rows with one `episode_index`, in order; an episode never crosses a file."""
        found = []
        begin = 0
        for number, rows in enumerate(self.file_rows):
            index = self.columns["episode_index"][begin : begin + rows]
            cuts = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), rows]
            found += [Span(int(index[a]), begin + a, begin + b, number) for a, b in itertools.pairwise(cuts) if b > a]
            begin += rows
        return found

    def video_file(self, camera: str, row: dict[str, Any]) -> Path:
        """File with an episode's video.

        Raises:
            KeyError: the row names none.
        """
        place = {"chunk_index": row[f"videos/{camera}/chunk_index"], "file_index": row[f"videos/{camera}/file_index"]}
        return self.root / str(self.info.get("video_path") or VIDEO_PATH).format(video_key=camera, **place)

    def data_file(self, row: dict[str, Any]) -> Path:
        """File with an episode's rows.

        Raises:
            KeyError: the row names none.
        """
        place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        return self.root / str(self.info.get("data_path") or DATA_PATH).format(**place)


def read_info(root: Path) -> dict[str, Any]:
    """`meta/info.json`, after a check of the keys that everything else needs.

    Raises:
        DataError: no folder, no such file, damaged, or of another format version.
    """
    if not root.is_dir():
        raise DataError(f"{root}: got no such folder, expected a LeRobot v3.0 data set; check the path")
    path = root / INFO_NAME
    if not path.is_file():
        raise DataError(
            f"{root}: got no {INFO_NAME}, expected a LeRobot v3.0 data set; check the path or pull it again"
        )
    try:
        info: dict[str, Any] = json.loads(path.read_text())
        version = str(info["codebase_version"])
        fps, _ = float(info["fps"]), (int(info["total_frames"]), int(info["total_episodes"]))
        cells = [(str(f["dtype"]), tuple(int(n) for n in f["shape"])) for f in info["features"].values()]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: got {error!r}, expected LeRobot's metadata; pull or collect it again") from error
    if not version.startswith("v3."):
        cure = "convert it by LeRobot's convert_dataset_v21_to_v30" if version.startswith("v2") else "see LeRobot"
        raise DataError(f"{root}: got LeRobot format {version}, expected v3.0; {cure}")
    missing = [name for name in REQUIRED if name not in info["features"]]
    if fps <= 0 or not cells or missing:
        raise DataError(f"{path}: got fps {fps} and no feature {missing}, expected a positive rate and {REQUIRED}")
    return info


def read_contents(root: str | Path, problems: Problems) -> Contents:
    """Read all but the frames. What cannot be read is left out and noted in `problems`.

    Raises:
        DataError: as `read_info`; without it nothing else can be understood.
    """
    folder = Path(root)
    info = read_info(folder)
    tasks = _read_tasks(folder, problems)
    episodes: list[Episode] = []
    for path in sorted((folder / "meta" / "episodes").glob("*/*.parquet")):
        table = read_table(path, problems)
        if table is not None:
            episodes += _episodes(path, table, problems)
    episodes.sort(key=lambda episode: episode.index)
    names = [name for name, feature in info["features"].items() if feature["dtype"] not in ("image", "video")]
    files, counts = [], []
    pieces: dict[str, list[Array]] = {name: [] for name in names}
    for path in sorted((folder / "data").glob("*/*.parquet")):
        rows = _columns(path, names, info["features"], problems)
        if rows is not None:
            files.append(path)
            counts.append(len(rows["index"]))
            for name in names:
                pieces[name].append(rows[name])
    columns = {name: np.concatenate(piece) if piece else np.zeros(0, np.int64) for name, piece in pieces.items()}
    return Contents(folder, info, episodes, tasks, files, counts, columns)


def read_table(path: Path, problems: Problems, columns: Sequence[str] | None = None) -> Any:
    """A parquet file as a table, or None (noted) where it has no footer or lacks a column."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path).read(columns=None if columns is None else list(columns))
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())[:120]
        problems.error(
            "unreadable parquet", f"{path}: cannot be read ({reason}), expected a whole parquet file with a footer"
        )
        return None


def to_array(column: Any, shape: Sequence[int]) -> Array:
    """A table's column as (n, *shape); the shape (1,) gives (n,). Text and records come as objects.

    Raises:
        ValueError: it has missing values, or another shape.
    """
    import pyarrow as pa

    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays([chunk.storage for chunk in array.chunks])
    rows = len(array)
    if array.null_count:
        raise ValueError(f"{array.null_count} missing values")
    while isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        if pa.types.is_struct(array.type.value_type):
            break
        array = array.flatten()
    if pa.types.is_nested(array.type):
        objects = np.empty(rows, object)
        objects[:] = array.to_pylist()
        return objects
    values: Array = array.to_numpy(zero_copy_only=False)
    return values.reshape(rows, *(() if tuple(shape) in ((), (1,)) else shape))


def _columns(
    path: Path, names: Sequence[str], features: dict[str, dict[str, Any]], problems: Problems
) -> dict[str, Array] | None:
    table = read_table(path, problems, names)
    if table is None:
        return None
    rows = {}
    for name in names:
        if name not in table.column_names:
            problems.error("missing column", f"{path}: got no column {name}, expected every feature of {INFO_NAME}")
            return None
        try:
            rows[name] = to_array(table.column(name), features[name]["shape"])
        except ValueError as error:
            expected = tuple(features[name]["shape"])
            problems.error(
                "wrong shape", f"{path}: got column {name} with {error}, expected values of shape {expected}"
            )
            return None
    return rows


def _read_tasks(root: Path, problems: Problems) -> dict[int, str]:
    path = root / TASKS_NAME
    if not path.is_file():
        problems.error("missing tasks", f"{path}: got no such file, expected the tasks in words")
        return {}
    table = read_table(path, problems)
    if table is None:
        return {}
    words = next((name for name in table.column_names if name in ("task", "__index_level_0__")), None)
    if words is None or "task_index" not in table.column_names:
        problems.error("missing tasks", f"{path}: got columns {table.column_names}, expected task and task_index")
        return {}
    numbers = table.column("task_index").to_pylist()
    return dict(zip((int(n) for n in numbers), map(str, table.column(words).to_pylist()), strict=True))


def _episodes(path: Path, table: Any, problems: Problems) -> list[Episode]:
    found = []
    for row in table.to_pylist():
        stats: Stats = {}
        for key in [key for key in row if key.startswith("stats/")]:
            value, (_, feature, name) = row.pop(key), key.split("/", 2)
            if value is not None:
                stats.setdefault(feature, {})[name] = np.asarray(value, np.float64)
        try:
            tasks = tuple(str(task) for task in row["tasks"] or ())
            found.append(Episode(int(row["episode_index"]), int(row["length"]), tasks, row, stats))
        except (KeyError, TypeError, ValueError) as error:
            problems.error("damaged episode row", f"{path}: got {error!r}, expected episode_index, length and tasks")
    return found
