"""Reading LeRobot v3.0 data sets from their files, with errors that say what to do.

LeRobot's own reader turns a missing root into a Hub request, copies the parquet into an Arrow cache and decodes one row
at a time. A cache is built from all rows in order, so we read parquet, PNG and video directly, in order. `tests/data`
checks that the frames are those of `LeRobotDataset`.

Shapes: F frames, E episodes, H W image height and width, A action width.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.video import frames_at
from playslot_rl.errors import DataError

FRAMES_A_PIECE = 256
_MIB = 1 << 20


@dataclass(frozen=True)
class LeRobotFiles:
    """The files of one data set, after a check that they are all there and agree.

    Attributes:
        root: its folder.
        info: `meta/info.json`.
    """

    root: Path
    info: dict[str, Any]

    @property
    def frames(self) -> int:
        """F."""
        return int(self.info["total_frames"])

    @property
    def fps(self) -> float:
        """Frames a second."""
        return float(self.info["fps"])

    @property
    def cameras(self) -> list[str]:
        """Names of the image and video features."""
        return [name for name, f in self.info["features"].items() if f.get("dtype") in ("image", "video")]

    @property
    def data_files(self) -> list[Path]:
        """Parquet files of the rows, in order."""
        return sorted((self.root / "data").glob("*/*.parquet"))

    @property
    def episode_files(self) -> list[Path]:
        """Parquet files of the episodes, in order."""
        return sorted((self.root / "meta" / "episodes").glob("*/*.parquet"))

    @cached_property
    def episodes(self) -> list[dict[str, Any]]:
        """One row an episode, without statistics, in order."""
        import pyarrow.parquet as pq

        rows: list[dict[str, Any]] = []
        for path in self.episode_files:
            names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
            rows.extend(pq.read_table(path, columns=names).to_pylist())
        return sorted(rows, key=lambda row: int(row["episode_index"]))

    @property
    def task(self) -> str:
        """The first task, in words; empty if none is named."""
        tasks = self.episodes[0].get("tasks") or [] if self.episodes else []
        return str(tasks[0]) if tasks else ""

    def column(self, name: str) -> npt.NDArray[Any] | None:
        """A numeric feature of all rows, (F, ...) in order, or None if the data set has no such feature."""
        import pyarrow.parquet as pq

        if name not in self.info["features"]:
            return None
        pieces = []
        for path in self.data_files:
            column = pq.read_table(path, columns=[name]).column(0)
            pieces.append(np.asarray(column.to_pylist()))
        values = np.concatenate(pieces)
        shape = tuple(self.info["features"][name].get("shape") or ())
        flat = shape in ((), (1,))
        rows: npt.NDArray[Any] = values.reshape(len(values), *(() if flat else shape))
        return rows

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

    def fingerprint(self, camera: str) -> str:
        """Content hash of the metadata, the rows and the camera's videos: 16 hex digits."""
        digest = hashlib.sha256()
        paths = [self.root / "meta" / "info.json", *self.episode_files, *self.data_files]
        paths += sorted((self.root / "videos" / camera).rglob("*.mp4"))
        for path in paths:
            digest.update(str(path.relative_to(self.root)).encode())
            with path.open("rb") as file:
                while piece := file.read(8 * _MIB):
                    digest.update(piece)
        return digest.hexdigest()[:16]

    def pieces(self, camera: str) -> Iterator[npt.NDArray[np.uint8]]:
        """All frames of a camera, in order, as uint8 pieces (n, H, W, 3).

        Raises:
            DataError: a frame or a video cannot be decoded.
        """
        is_video = self.info["features"][camera]["dtype"] == "video"
        yield from self._video_pieces(camera) if is_video else self._image_pieces(camera)

    def _image_pieces(self, camera: str) -> Iterator[npt.NDArray[np.uint8]]:
        import pyarrow.parquet as pq

        # PNG decoding releases the interpreter lock; two threads suffice to keep one core busy with it.
        with ThreadPoolExecutor(2) as pool:
            for path in self.data_files:
                for rows in pq.ParquetFile(path).iter_batches(FRAMES_A_PIECE, columns=[camera]):
                    cells = rows.column(0).to_pylist()
                    try:
                        yield np.stack(list(pool.map(self._decode, cells)))
                    except (OSError, ValueError, TypeError, KeyError) as error:
                        raise DataError(
                            f"{path}: a frame of {camera} cannot be decoded ({error}), expected PNG or JPEG images of "
                            "one size: the data set is damaged, collect or pull it again"
                        ) from error

    def _decode(self, cell: dict[str, Any]) -> npt.NDArray[np.uint8]:
        from PIL import Image

        content = cell["bytes"] if cell.get("bytes") else (self.root / cell["path"]).read_bytes()
        with Image.open(io.BytesIO(content)) as image:
            return np.asarray(image.convert("RGB"))

    def _video_pieces(self, camera: str) -> Iterator[npt.NDArray[np.uint8]]:
        def file_of(row: dict[str, Any]) -> Path:
            chunk, file = row[f"videos/{camera}/chunk_index"], row[f"videos/{camera}/file_index"]
            name = str(self.info["video_path"])
            return self.root / name.format(video_key=camera, chunk_index=chunk, file_index=file)

        for path, rows in itertools.groupby(self.episodes, file_of):
            begins = [(float(row[f"videos/{camera}/from_timestamp"]), int(row["length"])) for row in rows]
            times = [begin + i / self.fps for begin, length in begins for i in range(length)]
            frames = frames_at(path, times, 0.25 / self.fps)
            while piece := list(itertools.islice(frames, FRAMES_A_PIECE)):
                yield np.stack(piece)


def open_files(root: str | Path) -> LeRobotFiles:
    """Check a data set's files and open them.

    Raises:
        DataError: it is missing, foreign, of another format version, unfinalised or truncated.
    """
    folder = Path(root).expanduser()
    if not str(root):
        raise DataError("data.root is empty, expected the folder of a LeRobot data set: set data.root=")
    if not folder.is_dir():
        raise DataError(f"data.root={root}: no such folder, expected a LeRobot data set: run `playslot collect` first")
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise DataError(f"data.root={root}: got no meta/info.json, expected a LeRobot v3.0 data set: check data.root=")
    try:
        info = json.loads(path.read_text())
        version = str(info["codebase_version"])
        _ = info["features"].items(), int(info["total_frames"]), int(info["total_episodes"]), float(info["fps"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} is damaged ({error!r}), expected LeRobot's metadata: collect or pull it again"
        ) from error
    if not version.startswith("v3."):
        raise DataError(
            f"{root}: got LeRobot format {version}, expected v3.0: convert it by LeRobot's convert_dataset_v21_to_v30"
        )
    files = LeRobotFiles(folder, info)
    _check_rows(files)
    return files


def _check_rows(files: LeRobotFiles) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    unfinished = (
        "it was never finalised, or is truncated: collect it again (the same `playslot collect` command carries on), "
        "or call finalize() on the LeRobotDataset that wrote it"
    )
    if not files.data_files or not files.episode_files:
        raise DataError(
            f"{files.root}: got no rows under data/ and meta/episodes/, expected parquet files; {unfinished}"
        )
    rows = 0
    for path in [*files.episode_files, *files.data_files]:
        try:
            count = pq.read_metadata(path).num_rows
        except (pa.ArrowException, OSError) as error:
            raise DataError(
                f"{path}: got a parquet file without a footer, expected a whole one; {unfinished}"
            ) from error
        rows += count if path in files.data_files else 0
    lengths = sum(int(row["length"]) for row in files.episodes)
    if not (rows == lengths == files.frames and len(files.episodes) == int(files.info["total_episodes"])):
        raise DataError(
            f"{files.root}: got {rows} rows and {len(files.episodes)} episodes of {lengths} frames, expected "
            f"{files.frames} frames in {files.info['total_episodes']} episodes as in meta/info.json; {unfinished}"
        )
    if files.frames == 0:
        raise DataError(f"{files.root}: got an empty data set, expected episodes: collect some first")
