"""Reading LeRobot v3.0 data sets from their files, as far as they can be read; `data/frames.py` decodes the frames.

LeRobot's own reader turns a missing root into a Hub request and copies the parquet into an Arrow cache.

Shapes: F rows (frames), E episodes.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from playslot_rl.config.weights import is_remote
from playslot_rl.data.problems import Problems
from playslot_rl.data.tables import UNREADABLE, Array, Episode, episodes_of, read_columns, read_table, read_tasks
from playslot_rl.errors import DataError

if TYPE_CHECKING:
    from playslot_rl.data.remote import Remote

FORMAT_TAG: Final = "v3.0"
"""Tag that LeRobot looks for on the Hub; equal to its CODEBASE_VERSION, whose import costs seconds."""
INFO_NAME: Final = "meta/info.json"
STATS_NAME: Final = "meta/stats.json"
RECORD_NAME: Final = "meta/playslot.json"
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACE: Final = ("index", "episode_index", "task_index")
"""Columns that say where a row stands in its data set: they change when data sets are merged or split."""
REQUIRED: Final = ("timestamp", "frame_index", *PLACE)


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
        return path.is_file() if self.remote is None else self.remote.holds(path)

    def opened(self, path: Path) -> Any:
        """A file, as pyarrow and PyAV take one: a path, or an open binary file where it is remote."""
        return path if self.remote is None else self.remote.open(path)

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
            raise DataError(f"{self.name}: got {len(self.cameras)} cameras ({names}), expected one: set data.camera=")
        if wanted not in self.cameras:
            raise DataError(f"data.camera={wanted}: {self.name} has no such camera, expected one of: {names}")
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
        paths = [self.root / INFO_NAME, *episode_files(self.root), *_data_files(self.root)]
        paths += sorted((self.root / "videos" / camera).rglob("*.mp4"))
        for path in paths:
            digest.update(str(path.relative_to(self.root)).encode())
            with path.open("rb") as file:
                while piece := file.read(8 << 20):
                    digest.update(piece)
        return digest.hexdigest()[:16]


def _data_files(root: Path) -> list[Path]:
    return sorted((root / "data").glob("*/*.parquet"))


def episode_files(root: Path) -> list[Path]:
    """Parquet files of the episodes' metadata, in order."""
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
    info, episodes, tasks = read_metadata(folder, problems, statistics=statistics)
    files, counts, columns = read_columns(_data_files(folder), info, problems)
    return Contents(folder, info, episodes, tasks, files, counts, columns)


def read_metadata(
    folder: Path, problems: Problems, *, statistics: bool = True
) -> tuple[dict[str, Any], list[Episode], dict[int, str]]:
    """`info`, `episodes` and `tasks` of a data set's `Contents`; arguments and errors of `read_contents`."""
    info = read_info(folder)
    tasks = read_tasks(folder, problems)
    episodes: list[Episode] = []
    for path in episode_files(folder):
        table = read_table(path, problems, lambda name: statistics or not name.startswith("stats/"))
        if table is not None:
            episodes += episodes_of(path, table, problems)
    episodes.sort(key=lambda episode: episode.index)
    return info, episodes, tasks


def open_files(root: str | Path) -> Contents:
    """Read a data set for training, without statistics, after a check that its files are all there and agree.

    Raises:
        DataError: it is missing, foreign, of another format version, unfinalised, truncated or empty.
    """
    folder, expected = Path(root).expanduser(), "expected a LeRobot"
    if not str(root):
        raise DataError(f"data.root is empty, {expected} data set's folder: set data.root=")
    if is_remote(root):
        raise DataError(
            f"{root}: got a data set on the Hub, expected a folder, or data.stream=true where videos are trained on: "
            "pull it by `playslot dataset pull USER/NAME DIR`"
        )
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
    if not _data_files(folder) or not episode_files(folder):
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
