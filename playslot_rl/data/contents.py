"""Reading LeRobot v3.0 data sets from their files, as far as they can be read; `data/frames.py` decodes the frames.

LeRobot's own reader turns a missing root into a Hub request and copies the parquet into an Arrow cache.

Shapes: F rows (frames), E episodes.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.problems import Problems
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

EPISODES_AT_ONCE: Final = 64
"""Of the metadata with statistics, some 150 columns."""
UNREADABLE: Final = "unreadable parquet"

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
    def videos(self) -> list[str]:
        """Features whose frames are in mp4 files."""
        return [name for name, feature in self.features.items() if feature["dtype"] == "video"]

    @property
    def cameras(self) -> list[str]:
        """Names of the image and video features."""
        return [name for name, feature in self.features.items() if feature["dtype"] in ("image", "video")]

    def camera(self, wanted: str) -> str:
        """The camera to read: the wanted one, or the only one.

        Raises:
            DataError: there is no such camera, none at all, or several and none was named.
        """
        names = ", ".join(self.cameras) or "none"
        if not wanted and len(self.cameras) == 1:
            return self.cameras[0]
        if not wanted:
            raise DataError(f"{self.root}: got {len(self.cameras)} cameras ({names}), expected one: set data.camera=")
        if wanted not in self.cameras:
            raise DataError(f"data.camera={wanted}: {self.root} has no such camera, expected one of: {names}")
        return wanted

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

    def video_file(self, camera: str, row: dict[str, Any]) -> Path | None:
        """File with an episode's video, or None where its row names none."""
        return self._file(f"videos/{camera}", self.info.get("video_path") or VIDEO_PATH, row, video_key=camera)

    def data_file(self, row: dict[str, Any]) -> Path | None:
        """File with an episode's rows, or None where its row names none."""
        return self._file("data", self.info.get("data_path") or DATA_PATH, row)

    def _file(self, prefix: str, template: str, row: dict[str, Any], **names: str) -> Path | None:
        try:
            place = {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}
            return self.root / template.format(**place, **names)
        except (KeyError, ValueError, TypeError):
            return None

    def file_hash(self, camera: str) -> str:
        """Hash of the metadata, the rows and the camera's videos as they are stored: 16 hex digits."""
        digest = hashlib.sha256()
        paths = [self.root / INFO_NAME, *_episode_files(self.root), *_data_files(self.root)]
        paths += sorted((self.root / "videos" / camera).rglob("*.mp4"))
        for path in paths:
            digest.update(str(path.relative_to(self.root)).encode())
            with path.open("rb") as file:
                while piece := file.read(8 << 20):
                    digest.update(piece)
        return digest.hexdigest()[:16]


def _data_files(root: Path) -> list[Path]:
    return sorted((root / "data").glob("*/*.parquet"))


def _episode_files(root: Path) -> list[Path]:
    return sorted((root / "meta" / "episodes").glob("*/*.parquet"))


def is_depth(feature: dict[str, Any]) -> bool:
    """Whether a camera feature is a depth map, whose values are not scaled to [0, 1]."""
    info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def stated_size(feature: dict[str, Any]) -> tuple[int, int]:
    """(H, W) that a camera feature states, whichever way round its shape is."""
    shape, names = feature["shape"], feature.get("names") or [""]
    channels_first = names[0] in ("channel", "channels") or (len(shape) == 3 and shape[2] not in (1, 3, 4))
    height, width = shape[1:3] if channels_first else shape[:2]
    return int(height), int(width)


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
        raise DataError(
            f"{path}: got {error!r}, a damaged file, expected LeRobot's metadata; pull or collect it again"
        ) from error
    if not version.startswith("v3."):
        cure = "convert it by LeRobot's convert_dataset_v21_to_v30" if version.startswith("v2") else "see LeRobot"
        raise DataError(f"{root}: got LeRobot format {version}, expected v3.0; {cure}")
    missing = [name for name in REQUIRED if name not in info["features"]]
    if fps <= 0 or not cells or missing:
        raise DataError(f"{path}: got fps {fps} and no feature {missing}, expected a positive rate and {REQUIRED}")
    return info


def read_contents(root: str | Path, problems: Problems, *, statistics: bool = True) -> Contents:
    """Read all but the frames. What cannot be read is left out and noted in `problems`.

    Args:
        root: folder of the data set.
        problems: what is wrong with it.
        statistics: read those of each episode.

    Raises:
        DataError: as `read_info`; without it nothing else can be understood.
    """
    folder = Path(root)
    info = read_info(folder)
    tasks = _read_tasks(folder, problems)
    episodes: list[Episode] = []
    for path in _episode_files(folder):
        table = _read_table(path, problems, lambda name: statistics or not name.startswith("stats/"))
        if table is not None:
            episodes += _episodes(path, table, problems)
    episodes.sort(key=lambda episode: episode.index)
    names = [name for name, feature in info["features"].items() if feature["dtype"] not in ("image", "video")]
    files, parts = [], []
    for path in _data_files(folder):
        rows = _columns(path, names, info["features"], problems)
        if rows is not None:
            files.append(path)
            parts.append(rows)
    counts = [len(rows["index"]) for rows in parts]
    columns = {name: np.concatenate([rows[name] for rows in parts] or [np.zeros(0, np.int64)]) for name in names}
    return Contents(folder, info, episodes, tasks, files, counts, columns)


def open_files(root: str | Path) -> Contents:
    """Read a data set for training, without statistics, after a check that its files are all there and agree.

    Raises:
        DataError: it is missing, foreign, of another format version, unfinalised, truncated or empty.
    """
    folder, expected = Path(root).expanduser(), "expected a LeRobot"
    if not str(root):
        raise DataError(f"data.root is empty, {expected} data set's folder: set data.root=")
    if not folder.is_dir():
        raise DataError(f"data.root={root}: no such folder, {expected} data set: run `playslot collect` first")
    if not (folder / INFO_NAME).is_file():
        raise DataError(f"data.root={root}: got no {INFO_NAME}, {expected} v3.0 data set: check data.root=")
    problems = Problems()
    contents = read_contents(folder, problems, statistics=False)
    unfinished = (
        "it was never finalised, or is truncated: collect it again (the same `playslot collect` command carries on), "
        "or call finalize() on the LeRobotDataset that wrote it"
    )
    if not _data_files(folder) or not _episode_files(folder):
        raise DataError(f"{root}: got no rows under data/ and meta/episodes/, expected parquet files; {unfinished}")
    unreadable = problems.of(UNREADABLE)
    if unreadable:
        raise DataError(f"{unreadable[0]}; {unfinished}")
    lengths, info = sum(episode.length for episode in contents.episodes), contents.info
    stated = int(info["total_frames"]), int(info["total_episodes"])
    if stated != (contents.rows, len(contents.episodes)) or lengths != contents.rows:
        raise DataError(
            f"{root}: got {contents.rows} rows and {len(contents.episodes)} episodes of {lengths} frames, expected "
            f"{stated[0]} frames in {stated[1]} episodes as in {INFO_NAME}; {unfinished}"
        )
    if not contents.rows:
        raise DataError(f"{root}: got an empty data set, expected episodes: collect some first")
    return contents


def _read_table(path: Path, problems: Problems, wanted: Callable[[str], bool] = bool) -> Any:
    """The wanted columns of a parquet file as a table, or None (noted) where it has no footer."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
        return file.read(columns=[name for name in file.schema_arrow.names if wanted(name)])
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())[:120]
        problems.error(
            UNREADABLE,
            f"{path}: cannot be read ({reason}): got a parquet file without a footer, expected a whole one",
        )
        return None


def _to_array(column: Any, shape: Sequence[int]) -> Array:
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
    table = _read_table(path, problems, names.__contains__)
    if table is None:
        return None
    rows = {}
    for name in names:
        if name not in table.column_names:
            problems.error("missing column", f"{path}: got no column {name}, expected every feature of {INFO_NAME}")
            return None
        try:
            rows[name] = _to_array(table.column(name), features[name]["shape"])
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
    table = _read_table(path, problems)
    if table is None:
        return {}
    words = next((name for name in table.column_names if name in ("task", "__index_level_0__")), None)
    if words is None or "task_index" not in table.column_names:
        problems.error("missing tasks", f"{path}: got columns {table.column_names}, expected task and task_index")
        return {}
    numbers = table.column("task_index").to_pylist()
    return dict(zip((int(n) for n in numbers), map(str, table.column(words).to_pylist()), strict=True))


def stored_episodes(contents: Contents) -> Iterator[Episode]:
    """The rows of `meta/episodes` with their statistics, one after the other as they are stored; unreadable ones, which
    `read_contents` notes, are left out.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in _episode_files(contents.root):
        try:
            with pq.ParquetFile(path) as file:
                for group in range(file.num_row_groups):
                    table = file.read_row_group(group)
                    for first in range(0, len(table), EPISODES_AT_ONCE):
                        yield from _episodes(path, table.slice(first, EPISODES_AT_ONCE), Problems())
        except (pa.ArrowException, OSError):
            continue


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
