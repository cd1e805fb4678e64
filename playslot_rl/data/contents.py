"""Reading LeRobot v3.0 data sets from their files, as far as they can be read; `data/frames.py` decodes the frames.

LeRobot's own reader turns a missing root into a Hub request and copies the parquet into an Arrow cache.

Shapes: F rows (frames), E episodes.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.data.metadata import CAMERAS, DATA_PATH, INFO_NAME, VIDEO_PATH, is_depth, read_info
from playslot_rl.data.places import Problems, filled, inside, note_odd_files, parquet_files
from playslot_rl.data.tables import Array, Episode, episodes_of, holds_numbers, read_columns, read_table, read_tasks
from playslot_rl.errors import DataError

if TYPE_CHECKING:
    from playslot_rl.data.remote import Remote

LATEST_S: Final = 1e8  # seconds: no video is longer


@dataclass(frozen=True)
class Span:
    """Rows `start` to `stop` (exclusive) with one `episode_index`, in the data file number `file`."""

    index: int
    start: int
    stop: int
    file: int

    @property
    def length(self) -> int:
        return self.stop - self.start


def in_runs(spans: Sequence[Span], full: Callable[[Sequence[Span], Span], bool]) -> list[list[Span]]:
    """Episodes in order, in runs; the next one begins where one is full."""
    found: list[list[Span]] = []
    for span in spans:
        if not found or full(found[-1], span):
            found.append([])
        found[-1].append(span)
    return found


@dataclass(frozen=True)
class Contents:
    """A data set as its files tell it.

    Attributes:
        tasks: `task_index` -> words.
        columns: every feature that is no camera, (F, ...), rows in the order of the files; numbers, or objects.
        remote: where the files of rows and videos are, if only the metadata lie in `root`.
    """

    root: Path
    info: dict[str, Any]
    episodes: list[Episode]
    tasks: dict[int, str]
    data_files: list[Path]
    file_rows: list[int]
    columns: dict[str, Array] = field(repr=False)
    remote: Remote | None = None

    @property
    def name(self) -> str:
        """The data set, for people."""
        return str(self.root) if self.remote is None else self.remote.address

    def holds(self, path: Path) -> bool:
        """Whether the data set has a file."""
        return path.is_file() and inside(self.root, path) if self.remote is None else self.remote.holds(path)

    def opened(self, path: Path) -> Any:
        """A file, as pyarrow and PyAV take one: a path, or an open binary file where it is remote."""
        return path if self.remote is None else self.remote.open(path)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        features: dict[str, dict[str, Any]] = self.info["features"]
        return features

    def numbers(self, name: str) -> Array | None:
        """A feature's column, if it is there and holds numbers."""
        values = self.columns.get(name)
        return values if values is not None and holds_numbers(values) else None

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def rows(self) -> int:
        """F: rows that are there, whatever `meta/info.json` says."""
        return sum(self.file_rows)

    @property
    def videos(self) -> list[str]:
        return [name for name, feature in self.features.items() if feature["dtype"] == "video"]

    @property
    def cameras(self) -> list[str]:
        return cameras_of(self.features)

    def camera(self, wanted: str) -> str:
        """The camera to read, by its full name: the wanted one, or the only one. A DataError where there is none, or
        several and none was named, or the wanted one is a depth map, whose 16 bits no picture of 8 has room for."""
        seen = [name for name in self.cameras if not is_depth(self.features[name])]
        names = ", ".join(seen) or "none of colours"
        if not wanted and len(seen) == 1:
            return seen[0]
        if not wanted:
            raise DataError(f"{self.name}: got {len(seen)} cameras ({names}), expected one: set data.camera=")
        name = full_name(wanted, self.cameras, self.name)
        if name not in seen:
            raise DataError(f"data.camera={wanted}: got a depth map, expected one of {self.name}'s {names}")
        return name

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
        return self._file(f"videos/{camera}", self.info.get("video_path") or VIDEO_PATH, row, camera)

    def named_videos(self, camera: str) -> set[Path]:
        """The files with a camera's videos, wherever `video_path` puts them, as far as they are there."""
        named = {self.video_file(camera, episode.row) for episode in self.episodes}
        return {path for path in named if path is not None and self.holds(path)}

    @cached_property
    def listing(self) -> list[tuple[str, int, int]]:
        """Name, size and time of each file, sorted."""
        paths = {path for folder in ("meta", "data", "videos") for path in (self.root / folder).rglob("*")}
        there = ((path, path.stat()) for path in paths.union(*map(self.named_videos, self.videos)) if path.is_file())
        return sorted((str(path.relative_to(self.root)), stat.st_size, stat.st_mtime_ns) for path, stat in there)

    def video_times(self, camera: str, row: dict[str, Any]) -> tuple[float, float] | None:
        """From where to where an episode lies in its video, seconds, or None where its row says no such thing."""
        times = [row.get(f"videos/{camera}/{side}_timestamp") for side in ("from", "to")]
        if not all(isinstance(time, int | float) and 0 <= time <= LATEST_S for time in times):
            return None
        return float(times[0]), float(times[1])  # type: ignore[arg-type]

    def data_file(self, row: dict[str, Any]) -> Path | None:
        """File with an episode's rows, or None where its row names none."""
        return self._file("data", self.info.get("data_path") or DATA_PATH, row)

    def _file(self, prefix: str, template: str, row: dict[str, Any], video_key: str = "") -> Path | None:
        path = filled(template, row.get(f"{prefix}/chunk_index"), row.get(f"{prefix}/file_index"), video_key)
        return None if path is None else self.root / path

    def file_hash(self, camera: str) -> str:
        """Hash of the metadata, the rows and the camera's videos as they are stored: 16 hex digits."""
        digest = hashlib.sha256()
        paths = [self.root / INFO_NAME, *parquet_files(self.root, "meta/episodes"), *parquet_files(self.root, "data")]
        paths += sorted({*(self.root / "videos" / camera).rglob("*.mp4"), *self.named_videos(camera)})
        for path in paths:
            digest.update(str(path.relative_to(self.root)).encode())
            with path.open("rb") as file:
                while piece := file.read(8 << 20):
                    digest.update(piece)
        return digest.hexdigest()[:16]


def read_contents(root: str | Path, problems: Problems, *, statistics: bool = True) -> Contents:
    """Read all but the frames, and statistics if they are wanted. What cannot be read is left out and noted in
    `problems`.

    Raises:
        DataError: as `read_info`; without it nothing else can be understood.
    """
    folder = Path(root)
    info, episodes, tasks = read_metadata(folder, problems, statistics=statistics)
    note_odd_files(folder, problems)
    files, counts, columns = read_columns(parquet_files(folder, "data"), info, problems)
    return Contents(folder, info, episodes, tasks, files, counts, columns)


def read_metadata(
    folder: Path, problems: Problems, *, statistics: bool = True
) -> tuple[dict[str, Any], list[Episode], dict[int, str]]:
    """`info`, `episodes` and `tasks` of a data set's `Contents`; arguments and errors of `read_contents`."""
    info = read_info(folder)
    tasks = read_tasks(folder, problems)
    episodes: list[Episode] = []
    for path in parquet_files(folder, "meta/episodes"):
        table = read_table(path, problems, lambda name: statistics or not name.startswith("stats/"))
        if table is not None:
            episodes += episodes_of(path, table, problems)
    episodes.sort(key=lambda episode: episode.index)
    return info, episodes, tasks


def full_name(wanted: str, cameras: Sequence[str], where: str) -> str:
    """The camera that a name means: itself, or the only one that ends with it after a dot, else a DataError.

    Examples:
        >>> full_name("top", ["observation.images.top", "observation.images.side"], "data/mine")
        'observation.images.top'
    """
    if wanted in cameras:
        return wanted
    called = [name for name in cameras if wanted and name.endswith(f".{wanted}")]
    if len(called) == 1:
        return called[0]
    if called:
        raise DataError(
            f"data.camera={wanted}: {where} has {len(called)} cameras of that name, expected one: say which of "
            f"{', '.join(called)}"
        )
    raise DataError(
        f"data.camera={wanted}: {where} has no such camera, expected one of: {', '.join(cameras) or 'none'}"
    )


def camera_list(text: str) -> list[str]:
    """The names in a text such as `top,side`."""
    return [name.strip() for name in text.split(",") if name.strip()]


def cameras_of(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [name for name, feature in features.items() if feature["dtype"] in CAMERAS]


def with_full_cameras(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the full names of `data.camera`, as a run stores it.

    Names stay as they were typed where the data sets are not there (yet), or do not know them: whoever reads them says
    what is wrong.
    """
    data = config.data
    typed = camera_list(data.camera)
    for root in () if not typed else (*data_roots(data.root), *data_roots(data.demos)):
        with contextlib.suppress(DataError):
            known = cameras_of(read_info(Path(root.path).expanduser())["features"])
            names = ",".join(full_name(name, known, root.path) for name in typed)
            return config if names == data.camera else replace(config, data=replace(data, camera=names))
    return config
