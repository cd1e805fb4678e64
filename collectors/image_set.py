"""LeRobot v3.0 data sets with stored images, written from PNGs that are there already.

LeRobot's own `add_frame` and `save_episode` write each image to a file of its own, read it again for the statistics and
a third time for the parquet file, and build a `datasets.Dataset` an episode, which takes about as long as recording it.
This writer makes the same files with LeRobot's own schema, metadata and statistics; a test compares the two.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.metadata import CAMERAS

EPISODES_AT_ONCE: Final = 32  # episodes in a row group


def feature(dtype: str, *shape: int, names: Sequence[str] | None = None) -> dict[str, Any]:
    """A feature as LeRobot states it; pictures have the names of their axes."""
    if dtype in CAMERAS:
        names = ("height", "width", "channels")
    return {"dtype": dtype, "shape": shape, "names": None if names is None else list(names)}


def new_set(repo_id: str, root: Path, fps: int, robot: str, features: dict[str, dict[str, Any]], **more: Any) -> Any:
    """A `LeRobotDataset` to be written; videos, where it has some, in h264 without loss."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    video = any(each["dtype"] == "video" for each in features.values())
    return LeRobotDataset.create(
        repo_id,
        fps=fps,
        features=features,
        root=root,
        robot_type=robot,
        use_videos=video,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0) if video else None,
        **more,
    )


@contextlib.contextmanager
def finalising(dataset: Any) -> Iterator[None]:
    """Finish a `LeRobotDataset` after the block. After an error nothing of it is finished: LeRobot's destructors would
    write the files later, in a folder that has been removed or made anew.
    """
    try:
        yield
        dataset.finalize()
    except BaseException:
        dataset.writer._finalized = dataset.meta._finalized = True
        raise


class ImageSetWriter:
    """Appends episodes to a data set that LeRobot has just created, with one image feature; `meta` is its
    `LeRobotDatasetMetadata`, `task` that of episodes that name none."""

    def __init__(self, meta: Any, root: Path, task: str) -> None:
        from lerobot.datasets.feature_utils import get_hf_features_from_features

        self.meta, self.root, self.task = meta, root, task
        (self._image,) = meta.image_keys
        self.schema = get_hf_features_from_features(meta.features).arrow_schema
        self._columns: list[dict[str, Any]] = []
        self._file: Any = None
        self._chunk = self._number = self._bytes = 0
        meta.save_episode_tasks([task])

    def add(
        self, values: dict[str, npt.NDArray[Any]], frames: npt.NDArray[np.uint8], images: list[bytes], task: str = ""
    ) -> None:
        """Append an episode of T frames; `values` (T, ...) are neither the image nor LeRobot's own index."""
        from lerobot.datasets.utils import update_chunk_file_indices

        task = task or self.task
        size = sum(map(len, images))
        if self._bytes and self._bytes + size > self.meta.data_files_size_in_mb * 2**20:
            self.close()
            self._chunk, self._number = update_chunk_file_indices(self._chunk, self._number, self.meta.chunks_size)
            self._bytes = 0
        self._bytes += size
        count, first, episode = len(images), self.meta.total_frames, self.meta.total_episodes
        index = np.arange(count)
        full = {
            **values,
            "timestamp": index / self.meta.fps,  # float64 for the statistics, as LeRobot does; stored as float32
            "frame_index": index,
            "episode_index": np.full(count, episode),
            "index": first + index,
            "task_index": np.full(count, self.meta.get_task_index(task)),
        }
        self._columns.append({**full, self._image: images})
        place = {
            "data/chunk_index": self._chunk,
            "data/file_index": self._number,
            "dataset_from_index": first,
            "dataset_to_index": first + count,
        }
        self.meta.save_episode(episode, count, [task], self._stats(full, frames), place)
        if len(self._columns) >= EPISODES_AT_ONCE:
            self._flush()

    def close(self) -> None:
        """Write what is left; the data set is readable once LeRobot has finalised its metadata too."""
        try:
            self._flush()
        finally:
            file, self._file = self._file, None
            if file is not None:
                file.close()

    def _flush(self) -> None:
        import pyarrow
        from pyarrow import parquet

        if not self._columns:
            return
        arrays = [
            pyarrow.chunked_array([_arrow(columns[field.name], field.type) for columns in self._columns])
            for field in self.schema
        ]
        if self._file is None:
            path = self.root / self.meta.data_path.format(chunk_index=self._chunk, file_index=self._number)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = parquet.ParquetWriter(path, self.schema, compression="snappy", use_dictionary=True)
        self._file.write_table(pyarrow.table(arrays, schema=self.schema))
        self._columns = []

    def _stats(self, values: dict[str, npt.NDArray[Any]], frames: npt.NDArray[np.uint8]) -> dict[str, Any]:
        """LeRobot's statistics of the episode, with its own sampling of the images."""
        from lerobot.datasets.compute_stats import compute_episode_stats, get_feature_stats, sample_indices

        features = self.meta.features
        flat = {
            name: array.reshape(len(array)) if tuple(features[name]["shape"]) == (1,) else array
            for name, array in values.items()
        }
        stats: dict[str, Any] = compute_episode_stats(flat, features)
        sampled = frames[sample_indices(len(frames))].transpose(0, 3, 1, 2)
        image = get_feature_stats(sampled, axis=(0, 2, 3), keepdims=True)
        stats[self._image] = {
            name: value if name == "count" else np.squeeze(value / 255.0, axis=0) for name, value in image.items()
        }
        return stats


def _arrow(values: Any, kind: Any) -> Any:
    """Arrow array of one column: images, scalars or vectors of fixed width."""
    import pyarrow

    if pyarrow.types.is_struct(kind):
        cells = [{"bytes": image, "path": f"frame-{i:06d}.png"} for i, image in enumerate(values)]
        return pyarrow.array(cells, type=kind)
    if pyarrow.types.is_fixed_size_list(kind):
        flat = pyarrow.array(np.ascontiguousarray(values).reshape(-1), type=kind.value_type)
        return pyarrow.FixedSizeListArray.from_arrays(flat, type=kind)
    return pyarrow.array(np.asarray(values, kind.to_pandas_dtype()).reshape(-1), type=kind)
