"""Parquet files of a LeRobot v3.0 data set as arrays and episodes; what cannot be read is noted and left out.

Shapes: F rows (frames).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.metadata import CAMERAS, MOST, NUMBERS, OTHERS, REQUIRED, WHOLE, damaged, whole
from playslot_rl.data.places import Problems, inside

TASKS_NAME: Final = "meta/tasks.parquet"
EPISODES_AT_ONCE: Final = 64  # of the metadata with statistics, some 150 columns
UNREADABLE: Final = "unreadable parquet"
MISSING: Final = "missing values"  # kind of warning
WRONG_COLUMN: Final = "wrong column"
MOST_ROWS: Final = 10**9  # of a data set, its frames or its episodes

Array = npt.NDArray[Any]
Stats = dict[str, dict[str, Array]]


@dataclass(frozen=True)
class Episode:
    """One row of `meta/episodes`.

    Attributes:
        row: all its values but the statistics.
        stats: feature -> statistic -> array, float64.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    row: dict[str, Any]
    stats: Stats


def read_columns(
    paths: Sequence[Path], info: dict[str, Any], problems: Problems, opened: Callable[[Path], Any] = Path
) -> tuple[list[Path], list[int], dict[str, Array]]:
    """The readable ones of some data files, rows of each, and every feature that is no camera, but those with values
    missing that are no fractions; `opened` gives a file as pyarrow takes one."""
    features = info["features"]
    names = [name for name, feature in features.items() if feature["dtype"] not in CAMERAS]
    files, parts = [], []
    for path in paths:
        rows = _columns(path, names, features, problems, opened)
        if rows is not None:
            files.append(path)
            parts.append(rows)
    counts = [len(rows["index"]) for rows in parts]
    known = [name for name in names if all(name in rows for rows in parts)]
    columns = {name: np.concatenate([rows[name] for rows in parts] or [np.zeros(0, np.int64)]) for name in known}
    return files, counts, columns


def read_table(
    path: Path, problems: Problems, wanted: Callable[[str], bool] = bool, opened: Callable[[Path], Any] = Path
) -> Any:
    """The wanted columns of a parquet file as a table, or None (noted) where it has no footer."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(opened(path))
        return file.read(columns=[name for name in file.schema_arrow.names if wanted(name)])
    except (pa.ArrowException, OSError, KeyError) as error:
        reason = " ".join(str(error).split())[:120]
        problems.error(
            UNREADABLE,
            f"{path}: cannot be read ({reason}): got a parquet file without a footer, expected a whole one",
        )
        return None


class _MissingError(ValueError):
    """Values are missing for which there is no NaN."""


def _to_array(column: Any, shape: Sequence[int]) -> Array:
    """A table's column as (n, *shape); the shape (1,) gives (n,). Text and records come as objects, fractions that are
    missing as NaN. A ValueError where other values are missing, or the shape is another one."""
    import pyarrow as pa
    import pyarrow.compute as pc

    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays([chunk.storage for chunk in array.chunks])
    if isinstance(array, pa.DictionaryArray):
        array = array.dictionary_decode()
    rows, lists = len(array), (pa.ListArray, pa.LargeListArray, pa.FixedSizeListArray)
    if isinstance(array, lists) and array.null_count and not pa.types.is_struct(array.type.value_type):
        cells = array.to_pylist()
        none = [None] * len(next((row for row in cells if row is not None), ()))
        array = pa.array([none if row is None else row for row in cells], array.type)
    while isinstance(array, lists) and not array.null_count and not pa.types.is_struct(array.type.value_type):
        ends = pc.min_max(pc.list_value_length(array)).as_py()
        if ends["min"] != ends["max"]:  # their values would move into each other's rows
            raise ValueError(f"lists of {ends['min']} to {ends['max']} values")
        array = array.flatten()
    if array.null_count and not pa.types.is_floating(array.type):
        raise _MissingError(f"{array.null_count} missing values")
    if pa.types.is_nested(array.type):
        objects = np.empty(rows, object)
        objects[:] = array.to_pylist()
        return objects
    values: Array = array.to_numpy(zero_copy_only=False)
    return values.reshape(rows, *(() if tuple(shape) in ((), (1,)) else shape))


def _columns(
    path: Path,
    names: Sequence[str],
    features: dict[str, dict[str, Any]],
    problems: Problems,
    opened: Callable[[Path], Any],
) -> dict[str, Array] | None:
    table = read_table(path, problems, names.__contains__, opened)
    if table is None:
        return None
    rows = {}
    for name in names:
        if table.column_names.count(name) != 1:
            got = "several columns" if name in table.column_names else "no column"
            problems.error(WRONG_COLUMN, f"{path}: got {got} {name}, expected every feature of meta/info.json once")
            return None
        try:
            rows[name] = _to_array(table.column(name), features[name]["shape"])
            _check_kind(name, rows[name], features[name]["dtype"])
        except _MissingError as error:
            if name in REQUIRED:
                problems.error(WRONG_COLUMN, f"{path}: got column {name} with {error}, expected one in every row")
                return None
            problems.warning(MISSING, f"{path}: got column {name} with {error}, expected none: it is left out")
        except (ValueError, TypeError, NotImplementedError) as error:
            expected, reason = tuple(features[name]["shape"]), " ".join(str(error).split())[:120]
            problems.error(
                WRONG_COLUMN, f"{path}: got column {name} with {reason}, expected values of shape {expected}"
            )
            return None
    return rows


def holds_numbers(values: Array) -> bool:
    """Whether a column holds numbers, truth values among them."""
    return values.dtype.kind in "fiub"


def _check_kind(name: str, values: Array, dtype: str) -> None:
    """Refuse text for numbers and numbers for text by a ValueError; other numbers than stated are still numbers."""
    stated, stored = bool(NUMBERS.fullmatch(dtype)), holds_numbers(values)
    if stated != stored and (stated or dtype in OTHERS):
        raise ValueError(f"values of type {'text or records' if values.dtype == object else values.dtype} for {dtype}")
    if name in WHOLE and values.dtype.kind not in "iu":
        raise ValueError(f"values of type {values.dtype} for whole numbers")


def read_tasks(root: Path, problems: Problems) -> dict[int, str]:
    """`task_index` -> words, of a data set's folder."""
    path = root / TASKS_NAME
    if not path.is_file() or not inside(root, path):
        problems.error("missing tasks", f"{path}: got no such file, expected the tasks in words")
        return {}
    table = read_table(path, problems)
    if table is None:
        return {}
    words = next((name for name in table.column_names if name in ("task", "__index_level_0__")), None)
    if words is None or "task_index" not in table.column_names:
        problems.error("missing tasks", f"{path}: got columns {table.column_names}, expected task and task_index")
        return {}
    try:
        numbers = [whole(number, 0, MOST) for number in table.column("task_index").to_pylist()]
    except ValueError as error:
        problems.error("missing tasks", f"{path}: got task_index {error}")
        return {}
    return dict(zip(numbers, map(str, table.column(words).to_pylist()), strict=True))


def episodes_of(path: Path, table: Any, problems: Problems) -> list[Episode]:
    """The readable rows of a table of `meta/episodes`, read from `path`."""
    found = []
    for row in table.to_pylist():
        stats: Stats = {}
        for key in [key for key in row if key.startswith("stats/")]:
            value, (feature, _, name) = row.pop(key), key.removeprefix("stats/").rpartition("/")
            try:
                if value is not None:
                    stats.setdefault(feature, {})[name] = np.asarray(value, np.float64)
            except (TypeError, ValueError) as error:
                problems.error("wrong statistics", f"{path}: got {key} that is {damaged(error)}, expected numbers")
        try:
            tasks = tuple(str(task) for task in row["tasks"] or ())
            index, length = whole(row["episode_index"], 0, MOST_ROWS), whole(row["length"], 1, MOST_ROWS)
            found.append(Episode(index, length, tasks, row, stats))
        except (KeyError, TypeError, ValueError) as error:
            problems.error(
                "damaged episode row", f"{path}: got {damaged(error)}, expected episode_index, length and tasks"
            )
    return found


def stored_episodes(paths: Sequence[Path], problems: Problems) -> Iterator[Episode]:
    """The rows of `meta/episodes` with their statistics, one after the other as they are stored. Unreadable ones, which
    `read_contents` notes, are left out; statistics that are no numbers go to `problems`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in paths:
        try:
            with pq.ParquetFile(path) as file:
                for group in range(file.num_row_groups):
                    table = file.read_row_group(group)
                    for first in range(0, len(table), EPISODES_AT_ONCE):
                        rows, seen = table.slice(first, EPISODES_AT_ONCE), Problems()
                        yield from episodes_of(path, rows, seen)
                        for line in seen.of("wrong statistics"):
                            problems.error("wrong statistics", line)
        except (pa.ArrowException, OSError):
            continue
