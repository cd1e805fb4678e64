"""Writing a data set from whole episodes of others: what merge, split and repair have in common.

Rows are copied as they are stored, images without decoding, videos packet by packet; only a row's place (`index`,
`episode_index`, `task_index`) and its statistics are made anew.

Note: LeRobot's `aggregate_datasets` and `split_dataset` do the same with pandas, but leave the statistics of places
stale, name wrong files of `meta/episodes` after merging sets of several shards, and encode videos again when they
split; `split_dataset` also reads the whole metadata once an episode.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from playslot_rl.data.contents import Contents, Span
from playslot_rl.data.metadata import (
    DATA_PATH,
    EPISODES_PATH,
    INFO_NAME,
    RECORD_NAME,
    STATS_NAME,
    VIDEO_PATH,
    read_record,
)
from playslot_rl.data.tables import TASKS_NAME, Array, Episode, Stats
from playslot_rl.datasets.statistics import Aggregate, of_numbers, reduced
from playslot_rl.datasets.video_copy import VideoCopier
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

MEGABYTE: Final = 2**20
ROWS_OF_METADATA: Final = 1000


@dataclass(frozen=True)
class Choice:
    """Episodes of one data set.

    Attributes:
        spans: rows of the episodes to take, in order.
        episodes: their metadata, in the same order; statistics as they shall be, those of places are made anew.
    """

    contents: Contents
    spans: Sequence[Span]
    episodes: Sequence[Episode]


def choose(contents: Contents, indices: Sequence[int]) -> Choice:
    """Episodes of a sound data set by their index, which is their place."""
    return Choice(contents, [contents.spans[i] for i in indices], [contents.episodes[i] for i in indices])


def assemble(choices: Sequence[Choice], out: Path, made_by: str) -> None:
    """Write the data set `out` from the chosen episodes of sets with the same features and rate, one after the other.

    Raises:
        DataError: no episode was chosen, or a source cannot be read.
        OSError: full disk.
    """
    if not any(choice.spans for choice in choices):
        raise DataError(f"{out}: got no episode to write, expected at least one")
    out.mkdir(parents=True, exist_ok=True)
    info = _info(choices)
    tasks: dict[str, int] = {}  # numbered as they appear
    # LeRobot's defaults where nothing is stated.
    video_bytes = int(float(info.get("video_files_size_in_mb") or 200) * MEGABYTE)
    files = int(info.get("chunks_size") or 1000)
    cameras = choices[0].contents.videos
    copiers = {camera: VideoCopier(out, camera, float(info["fps"]), video_bytes, files) for camera in cameras}
    rows = _RowWriter(out, float(info.get("data_files_size_in_mb") or 100) * MEGABYTE, files)
    table: list[dict[str, Any]] = []
    all_stats: list[Stats] = []
    total = Aggregate()
    try:
        for choice in choices:
            contents = choice.contents
            for span, episode, piece in zip(choice.spans, choice.episodes, _pieces(choice), strict=True):
                numbers = contents.columns["task_index"][span.start : span.stop].tolist()
                task_index = np.array([tasks.setdefault(contents.tasks[n], len(tasks)) for n in numbers], np.int64)
                row, stats_of_places = rows.write(piece, task_index)
                for camera, copier in copiers.items():
                    path, times = contents.video_file(camera, episode.row), contents.video_times(camera, episode.row)
                    assert path is not None, "a sound data set, or one whose frames were decoded"
                    assert times is not None, "so are its times"
                    row |= copier.copy(path, times[0], episode.length)
                stats = {**_stored_stats(contents, episode), **stats_of_places}
                table.append(_episode_row(episode, row, stats))
                all_stats.append(stats)
    finally:
        rows.close()
        for copier in copiers.values():
            copier.close()
    try:
        for stats in all_stats:
            total.add(stats)
        _write_metadata(out, table, list(tasks))
        write_json(out / STATS_NAME, _plain(total.result()))
    except (ValueError, TypeError, KeyError) as error:  # pyarrow's are among them
        raise DataError(
            f"{choices[0].contents.root}: got statistics in meta/episodes that are no numbers, or of another shape in "
            f"each episode ({' '.join(str(error).split())[:80]}), expected LeRobot's: run `playslot dataset repair`"
        ) from error
    info |= {"total_episodes": rows.episodes, "total_frames": rows.rows, "total_tasks": len(tasks)}
    info["splits"] = {"train": f"0:{rows.episodes}"}
    write_json(out / INFO_NAME, info)
    _write_record(choices, out, made_by)


def _info(choices: Sequence[Choice]) -> dict[str, Any]:
    info: dict[str, Any] = copy.deepcopy(choices[0].contents.info)
    info |= {"data_path": DATA_PATH, "video_path": VIDEO_PATH if choices[0].contents.videos else None}
    for camera in choices[0].contents.videos:
        known = [choice.contents.features[camera].get("info") or {} for choice in choices]
        # How a video was encoded stands there only where it is true of all of them.
        info["features"][camera]["info"] = {
            k: v if all(k in other and other[k] == v for other in known) else None for k, v in known[0].items()
        }
    return info


def _pieces(choice: Choice) -> Iterator[Any]:
    """Tables of the chosen episodes' rows; each file is read once where episodes are in order."""
    import pyarrow.parquet as pq

    contents = choice.contents
    starts = np.cumsum([0, *contents.file_rows])
    number = -1
    table: Any = None
    for span in choice.spans:
        if span.file != number:
            number, table = span.file, pq.ParquetFile(contents.data_files[span.file]).read()
        yield table.slice(span.start - int(starts[span.file]), span.length)


class _RowWriter:
    """Rows of the new data set: one row group an episode, as LeRobot writes them."""

    def __init__(self, out: Path, limit: float, files: int) -> None:
        self.out, self.rows, self.episodes, self._number = out, 0, 0, -1
        self._limit, self._files, self._path = limit, files, out
        self._writer: Any = None
        self._schema: Any = None

    def write(self, table: Any, task_index: Array) -> tuple[dict[str, Any], Stats]:
        """Append an episode; returns its place and the statistics that depend on it."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        length = len(table)
        places = {
            "index": np.arange(self.rows, self.rows + length),
            "episode_index": np.full(length, self.episodes),
            "task_index": task_index,
        }
        for name, values in places.items():
            column = table.schema.get_field_index(name)
            table = table.set_column(column, table.schema.field(name), pa.array(values, table.schema.field(name).type))
        if self._schema is None:
            metadata = {k: v for k, v in (table.schema.metadata or {}).items() if k != b"pandas"}
            self._schema = table.schema.with_metadata(metadata or None)
        if self._writer is None or self._path.stat().st_size >= self._limit:
            self.close()
            self._number += 1
            chunk, file = divmod(self._number, self._files)
            self._path = self.out / DATA_PATH.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(self._path, self._schema, compression="snappy", use_dictionary=True)
        try:
            self._writer.write_table(table.select(self._schema.names).cast(self._schema))
        except (pa.ArrowException, KeyError) as error:
            raise DataError(
                f"{self._path.name}: got a data set whose columns are stored as others than those before "
                f"({' '.join(str(error).split())[:100]}), expected equal types: run `playslot dataset verify` on each"
            ) from error
        chunk, file = divmod(self._number, self._files)
        row = {
            "episode_index": self.episodes,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.rows,
            "dataset_to_index": self.rows + length,
        }
        self.rows, self.episodes = self.rows + length, self.episodes + 1
        return row, {name: of_numbers(values) for name, values in places.items()}

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def _stored_stats(contents: Contents, episode: Episode) -> Stats:
    """An episode's statistics of its features, all in the shape of LeRobot's."""
    return {
        name: reduced(stats, ([1, *contents.features[name]["shape"]])[-1]) if name in contents.columns else stats
        for name, stats in episode.stats.items()
        if name in contents.features
    }


def _episode_row(episode: Episode, changes: Mapping[str, Any], stats: Stats) -> dict[str, Any]:
    flat = {f"stats/{n}/{key}": value for n, group in _plain(stats).items() for key, value in group.items()}
    kept = {k: v for k, v in episode.row.items() if k not in ("episode_index", "tasks", "length")}
    row = {"episode_index": 0, "tasks": list(episode.tasks), "length": episode.length, **kept, **changes}
    return row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} | flat


def _write_metadata(out: Path, episodes: Sequence[Mapping[str, Any]], tasks: Sequence[str]) -> None:
    """`meta/episodes`, in one file, and the tasks in words."""
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = out / EPISODES_PATH.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    names = dict.fromkeys(name for row in episodes for name in row)
    table = pa.Table.from_pylist([{name: row.get(name) for name in names} for row in episodes])
    pq.write_table(table, path, row_group_size=ROWS_OF_METADATA)
    pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task")).to_parquet(out / TASKS_NAME)


def _plain(stats: Stats) -> dict[str, dict[str, Any]]:
    """Lists instead of arrays; counts are whole numbers."""
    return {
        name: {key: (value.astype(np.int64) if key == "count" else value).tolist() for key, value in group.items()}
        for name, group in stats.items()
    }


def _write_record(choices: Sequence[Choice], out: Path, made_by: str) -> None:
    """Our own record of seeds and outcomes, where every source has one."""
    records = [read_record(choice.contents.root) for choice in choices]
    if any(record is None for record in records):
        return
    episodes: list[Any] = []
    sources = []
    for choice, record in zip(choices, records, strict=True):
        assert record is not None
        episodes += [record["episodes"][span.index] for span in choice.spans if span.index < len(record["episodes"])]
        sources.append({"name": choice.contents.root.name, "episodes": len(choice.spans), "spec": record.get("spec")})
    content: dict[str, Any] = {"made_by": made_by, "sources": sources, "episodes": episodes}
    outcomes = [entry.get("success") for entry in episodes]
    if outcomes and None not in outcomes:
        content["success_rate"] = sum(map(bool, outcomes)) / len(outcomes)
    write_json(out / RECORD_NAME, content)
