"""Sketchy (Cabi et al. 2019, "Scaling data-driven robotics with reward sketching and batch RL") to LeRobot v3.0.

The published layout, as its download and extract scripts leave it:

    SOURCE/metadata.sqlite     tables Episodes (EpisodeId, TaskId, DataPath, ...) and EpisodeTags (EpisodeId, Tag)
    SOURCE/<DataPath>          one TFRecord file an episode, one tf.train.Example a timestep, 10 a second

A timestep holds `actions` (7 floats: what was done in response to this observation), proprioception, and one JPEG a
camera. Demonstrations are the episodes that carry a tag of `TAGS`.

TFRecord files are read without TensorFlow. A record is framed as: length (uint64), masked CRC of the length (uint32),
data, masked CRC of the data (uint32), all little-endian. The CRC is CRC-32C (Castagnoli), rotated right by 15 bits plus
a constant.

Shapes: H W image height and width.
"""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.collectors.image_set import feature, new_set
from playslot_rl.data.metadata import LARGEST_PICTURE
from playslot_rl.errors import ConfigError, DataError, OutputError
from playslot_rl.runtime.progress import quiet_datasets
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.folders import new_folder, require_free

CAMERAS: Final = {
    "front_left": "pixels/basket_front_left",
    "front_right": "pixels/basket_front_right",
    "back_left": "pixels/basket_back_left",
}
"""Name of a camera in our data sets -> feature of a timestep."""
PAPER_CAMERAS: Final = ("front_left", "front_right")
TAGS: Final = ("lift_green__demos", "stack_green_on_red__demos")  # the published sets of human demonstrations
PAPER_SPLIT: Final = (316, 78)  # training and evaluation episodes of the paper
STATE: Final = {"sawyer/tcp/pose": 7, "gripper/joints/angle": 1}
"""Proprioception and its widths: position (metres) and quaternion of the tool, opening of the gripper (radians)."""
ACTIONS: Final = "actions"
ACTION_DIM: Final = 7
FPS: Final = 10
META_NAME: Final = "meta/sketchy.json"
MASK_DELTA: Final = 0xA282EAD8
LONGEST: Final = 1 << 30
"""A record said to be longer than this (bytes) is taken for a damaged file or one that is no TFRecord."""

Value = list[bytes] | npt.NDArray[np.float32] | npt.NDArray[np.int64]


@dataclass(frozen=True)
class SketchyEpisode:
    """One demonstration: its id, task in words and file."""

    identity: str
    task: str
    path: Path


def find_demonstrations(source: Path, tags: Sequence[str] = TAGS) -> list[SketchyEpisode]:
    """The demonstrations with one of the tags that the metadata name, ordered by file name; files lie at any depth.

    Raises:
        DataError: another layout, no such episode, or an episode file that is not there.
    """
    metadata = source / "metadata.sqlite"
    if not metadata.is_file():
        raise DataError(
            f"{source}: got no metadata.sqlite, expected the folder that Sketchy's download.sh filled: check data.root="
        )
    marks = ", ".join("?" * len(tags))
    query = (
        "SELECT DISTINCT Episodes.EpisodeId, Episodes.TaskId, Episodes.DataPath FROM Episodes JOIN EpisodeTags "
        f"ON Episodes.EpisodeId = EpisodeTags.EpisodeId WHERE EpisodeTags.Tag IN ({marks})"
    )
    try:
        # Read-only and immutable: nothing is ever written beside the download.
        connection = sqlite3.connect(f"{metadata.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            rows = connection.execute(query, tuple(tags)).fetchall()
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise DataError(
            f"{metadata}: got {error}, expected Sketchy's tables Episodes and EpisodeTags: download it again"
        ) from error
    if not rows:
        raise DataError(f"{metadata}: got no episode tagged {' or '.join(tags)}, expected the human demonstrations")
    files = {path.name: path for path in sorted(source.rglob("*")) if path.is_file()}
    missing = sorted(row[2] for row in rows if Path(str(row[2])).name not in files)
    if missing:
        archives = any(name.endswith(".tar.bz2") for name in files)
        cure = "extract the archives by Sketchy's extract.sh" if archives else "download and extract them"
        raise DataError(
            f"{source}: got no file for {len(missing)} of {len(rows)} episodes, such as {missing[0]}: {cure}"
        )
    found = [SketchyEpisode(str(i), str(task or "unknown"), files[Path(str(name)).name]) for i, task, name in rows]
    return sorted(found, key=lambda episode: episode.path.name)


def split_episodes(count: int) -> tuple[int, int]:
    """Training and evaluation episodes: 316 and 78 of 394, and in that proportion of another number (at least 1).

    Note: the paper does not say which demonstrations it evaluates on. Ours are the last ones by file name, so that a
    split depends on nothing else.
    """
    train = min(count - 1, max(1, round(count * PAPER_SPLIT[0] / sum(PAPER_SPLIT)))) if count > 1 else count
    return train, count - train


def _numbers(path: Path, step: int, example: dict[str, Value], name: str, width: int) -> npt.NDArray[np.float32]:
    value = example.get(name)
    if not isinstance(value, np.ndarray) or value.shape != (width,):
        got = "nothing" if value is None else f"{len(value)} values"
        raise DataError(f"{path}: step {step} has {got} under {name}, expected {width} numbers as in Sketchy's layout")
    return value.astype(np.float32)


def _image(path: Path, step: int, example: dict[str, Value], camera: str, size: int) -> npt.NDArray[np.uint8]:
    from PIL import Image

    name, value = CAMERAS[camera], example.get(CAMERAS[camera])
    if not isinstance(value, list) or len(value) != 1:
        known = ", ".join(key for key, feature in CAMERAS.items() if feature in example) or "none"
        raise DataError(f"{path}: step {step} has no picture {name}, expected one: it has these cameras: {known}")
    try:
        with Image.open(io.BytesIO(value[0]), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > LARGEST_PICTURE:  # by its header: nothing has been decoded
                raise OSError(f"{image.width}x{image.height} pixels")
            # The paper resizes whole frames, without a crop; boxes average all pixels, so nothing flickers.
            return np.asarray(image.convert("RGB").resize((size, size), Image.Resampling.BOX))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: step {step}: {name} cannot be decoded, expected a JPEG: download it again") from error


def read_steps(episode: SketchyEpisode, cameras: Sequence[str], size: int) -> Iterator[dict[str, Any]]:
    """LeRobot rows of a demonstration, one a timestep.

    Raises:
        DataError: a truncated or damaged record, a missing camera, or features of another layout.
    """
    step = None
    for step, record in enumerate(read_records(episode.path)):
        try:
            example = parse_example(record)
        except DataError as error:
            raise DataError(f"{episode.path}: step {step}: {error}") from error
        state = [_numbers(episode.path, step, example, name, width) for name, width in STATE.items()]
        yield {
            **{f"observation.images.{name}": _image(episode.path, step, example, name, size) for name in cameras},
            keys.FEATURE_STATE: np.concatenate(state),
            keys.FEATURE_ACTION: _numbers(episode.path, step, example, ACTIONS, ACTION_DIM),
            "task": episode.task,
        }
    if step is None:
        raise DataError(f"{episode.path}: got an empty file, expected timesteps: download or extract it again")


def _write(root: Path, episodes: Sequence[SketchyEpisode], cameras: Sequence[str], size: int, storage: str) -> None:
    """One data set, finalised and counted."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    name = f"playslot_rl/sketchy_{root.name}"
    features = {f"observation.images.{camera}": feature(storage, size, size, 3) for camera in cameras}
    features[keys.FEATURE_STATE] = feature("float32", sum(STATE.values()))
    features[keys.FEATURE_ACTION] = feature("float32", ACTION_DIM)
    dataset = new_set(name, root, FPS, "sawyer", features)
    lengths = []
    for episode in episodes:
        lengths.append(0)
        for row in read_steps(episode, cameras, size):
            dataset.add_frame(row)
            lengths[-1] += 1
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    again = LeRobotDataset(name, root=root, video_backend="pyav")
    if (again.num_episodes, len(again)) != (len(episodes), sum(lengths)):
        raise OutputError(f"{root}: got {len(again)} frames, expected {sum(lengths)}; run the same command again")
    records = [
        {"id": episode.identity, "file": episode.path.name, "task": episode.task, "length": length}
        for episode, length in zip(episodes, lengths, strict=True)
    ]
    write_json(root / META_NAME, {"cameras": list(cameras), "episodes": records})


def convert_sketchy(
    source: str | Path,
    out: str | Path,
    *,
    cameras: Sequence[str] = PAPER_CAMERAS,
    image_size: int = 64,
    storage: Literal["image", "video"] = "image",
    tags: Sequence[str] = TAGS,
    episodes: int | None = None,
) -> dict[str, int]:
    """Convert the human demonstrations into two LeRobot data sets, `OUT/train` and `OUT/eval`.

    All is written under a temporary name and renamed at the end: an error or a kill leaves no `out`.

    Args:
        cameras: names out of `CAMERAS`; each is a feature `observation.images.NAME`.
        storage: `image` (PNG in parquet) or `video` (h264 yuv444p, crf 0).
        episodes: only so many, for a trial; None takes all.

    Returns:
        `{"train": episodes, "eval": episodes}`.

    Raises:
        ConfigError: an unknown or repeated camera, or none.
        DataError: another layout, a missing file or camera, a truncated or damaged record.
        OutputError: `out` is there already, or the disk is full.
    """
    source, out = Path(source).expanduser(), Path(out).expanduser().absolute()
    if not cameras or len(set(cameras)) < len(cameras) or not set(cameras) <= set(CAMERAS):
        raise ConfigError(f"data.camera: got {','.join(cameras) or 'none'}, expected some of {', '.join(CAMERAS)}")
    require_free(out)
    found = find_demonstrations(source, tags)[:episodes]
    train, held_out = split_episodes(len(found))
    with new_folder(out) as temporary:
        for name, part in (("train", found[:train]), ("eval", found[train:])):
            with quiet_datasets():  # once each: reading a set back makes `datasets` loud again
                if part:
                    _write(temporary / name, part, cameras, image_size, storage)
    return {"train": train, "eval": held_out}


def masked_crc(data: bytes) -> int:
    """The checksum that frames a record; a DataError where the package `crc32c` is not installed."""
    try:
        from crc32c import crc32c
    except ImportError as error:
        raise DataError(
            "got no package crc32c, expected it for reading TFRecord files: pip install 'playslot_rl[sketchy]'"
        ) from error
    crc: int = crc32c(data)
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def read_records(path: Path) -> Iterator[bytes]:
    """The records of a file, in order; a DataError where it is missing, truncated, damaged, or no TFRecord file."""
    try:
        with path.open("rb") as file:
            number = 0
            while header := file.read(12):
                if len(header) < 12:
                    raise _truncated(path, number, f"{len(header)} of 12 bytes of its header")
                length, crc = struct.unpack("<QI", header)
                if masked_crc(header[:8]) != crc or length > LONGEST:
                    damaged, foreign = (
                        "the file is damaged: download it again",
                        "expected a TFRecord file: check the path",
                    )
                    what = damaged if number else foreign
                    raise DataError(f"{path}: record {number} has a wrong checksum of its length, {what}")
                body = file.read(length + 4)
                if len(body) < length + 4:
                    raise _truncated(path, number, f"{len(body)} of {length + 4} bytes")
                if masked_crc(body[:length]) != struct.unpack("<I", body[length:])[0]:
                    raise DataError(
                        f"{path}: record {number} has a wrong checksum of its data, the file is damaged: "
                        "download it again"
                    )
                yield body[:length]
                number += 1
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}), expected a TFRecord file: check the path"
        ) from error


def _truncated(path: Path, number: int, got: str) -> DataError:
    return DataError(f"{path}: record {number} is truncated, got {got}: download or extract it again")


@cache
def example_class() -> Any:
    """The protobuf message `tf.train.Example`, declared here since it comes with TensorFlow only."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="playslot_rl/example.proto", package="playslot", syntax="proto3")

    def add(message: Any, name: str, number: int, kind: int, of: str | None = None, *, repeated: bool = False) -> Any:
        label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
        return message.field.add(name=name, number=number, type=kind, label=label, type_name=of and f".playslot.{of}")

    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, name in enumerate(("Bytes", "Float", "Int64"), 1):
        values = file.message_type.add(name=f"{name}List")
        add(values, "value", 1, getattr(kinds, f"TYPE_{name.upper()}"), repeated=True)
        add(feature, f"{name.lower()}_list", number, kinds.TYPE_MESSAGE, values.name).oneof_index = 0
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    add(entry, "key", 1, kinds.TYPE_STRING)
    add(entry, "value", 2, kinds.TYPE_MESSAGE, "Feature")
    add(features, "feature", 1, kinds.TYPE_MESSAGE, "Features.FeatureEntry", repeated=True)
    add(file.message_type.add(name="Example"), "features", 1, kinds.TYPE_MESSAGE, "Features")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("playslot.Example"))


def parse_example(record: bytes) -> dict[str, Value]:
    """Features of a `tf.train.Example`: name -> list of bytes, float32 array or int64 array; else a DataError."""
    from google.protobuf.message import DecodeError

    try:
        features = example_class().FromString(record).features.feature
    except DecodeError as error:
        raise DataError(
            "got a record that is no tf.train.Example, expected one: check that the file is whole"
        ) from error
    found: dict[str, Value] = {}
    for name, held in features.items():
        kind = held.WhichOneof("kind")
        if kind == "bytes_list":
            found[name] = list(held.bytes_list.value)
        elif kind is not None:
            dtype: type[Any] = np.float32 if kind == "float_list" else np.int64
            found[name] = np.array(getattr(held, kind).value, dtype)
    return found
