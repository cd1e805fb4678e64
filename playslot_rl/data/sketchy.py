"""Sketchy (Cabi et al. 2019, "Scaling data-driven robotics with reward sketching and batch RL") to LeRobot v3.0.

The published layout, as its download and extract scripts leave it:

    SOURCE/metadata.sqlite     tables Episodes (EpisodeId, TaskId, DataPath, ...) and EpisodeTags (EpisodeId, Tag)
    SOURCE/<DataPath>          one TFRecord file an episode, one tf.train.Example a timestep, 10 a second

A timestep holds `actions` (7 floats: what was done in response to this observation), proprioception, and one JPEG a
camera. Demonstrations are the episodes that carry a tag of `TAGS`.

Shapes: H W image height and width.
"""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.tfrecord import Value, parse_example, read_records
from playslot_rl.errors import ConfigError, DataError, OutputError
from playslot_rl.progress import quiet_datasets
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.folders import new_folder, require_free

CAMERAS: Final = {
    "front_left": "pixels/basket_front_left",
    "front_right": "pixels/basket_front_right",
    "back_left": "pixels/basket_back_left",
}
"""Name of a camera in our data sets -> feature of a timestep."""
PAPER_CAMERAS: Final = ("front_left", "front_right")
TAGS: Final = ("lift_green__demos", "stack_green_on_red__demos")
"""The published sets of human demonstrations."""
PAPER_SPLIT: Final = (316, 78)
"""Training and evaluation episodes of the paper."""
STATE: Final = {"sawyer/tcp/pose": 7, "gripper/joints/angle": 1}
"""Proprioception and its widths: position (metres) and quaternion of the tool, opening of the gripper (radians)."""
ACTIONS: Final = "actions"
ACTION_DIM: Final = 7
FPS: Final = 10
META_NAME: Final = "meta/sketchy.json"


@dataclass(frozen=True)
class SketchyEpisode:
    """One demonstration: its id, task in words and file."""

    identity: str
    task: str
    path: Path


def find_demonstrations(source: Path, tags: Sequence[str] = TAGS) -> list[SketchyEpisode]:
    """The demonstrations that the metadata name, ordered by file name.

    Args:
        source: folder with `metadata.sqlite` and the extracted episode files, at any depth.
        tags: episodes with one of these tags are taken.

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


def check_cameras(cameras: Sequence[str]) -> None:
    """Refuse unknown or repeated cameras.

    Raises:
        ConfigError: there is one, or no camera at all.
    """
    wrong = [name for name in cameras if name not in CAMERAS]
    if wrong or not cameras or len(set(cameras)) < len(cameras):
        raise ConfigError(f"data.camera: got {','.join(cameras) or 'none'}, expected some of {', '.join(CAMERAS)}")


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
        with Image.open(io.BytesIO(value[0])) as image:
            # The paper resizes whole frames, without a crop; boxes average all pixels, so nothing flickers.
            return np.asarray(image.convert("RGB").resize((size, size), Image.Resampling.BOX))
    except OSError as error:
        raise DataError(f"{path}: step {step}: {name} cannot be decoded, expected a JPEG: download it again") from error


def read_steps(episode: SketchyEpisode, cameras: Sequence[str], size: int) -> Iterator[dict[str, Any]]:
    """LeRobot rows of a demonstration, one a timestep.

    Raises:
        DataError: a truncated or damaged record, a missing camera, or features of another layout.
    """
    count = 0
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
        count += 1
    if count == 0:
        raise DataError(f"{episode.path}: got an empty file, expected timesteps: download or extract it again")


def _features(cameras: Sequence[str], size: int, storage: str) -> dict[str, dict[str, Any]]:
    shape = {"shape": (size, size, 3), "names": ["height", "width", "channels"]}
    width = sum(STATE.values())
    return {
        **{f"observation.images.{name}": {"dtype": storage, **shape} for name in cameras},
        keys.FEATURE_STATE: {"dtype": "float32", "shape": (width,), "names": None},
        keys.FEATURE_ACTION: {"dtype": "float32", "shape": (ACTION_DIM,), "names": None},
    }


def _write(root: Path, episodes: Sequence[SketchyEpisode], cameras: Sequence[str], size: int, storage: str) -> None:
    """One data set, finalised and counted."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    video = storage == "video"
    dataset = LeRobotDataset.create(
        f"playslot_rl/sketchy_{root.name}",
        fps=FPS,
        features=_features(cameras, size, storage),
        root=root,
        robot_type="sawyer",
        use_videos=video,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0) if video else None,
    )
    lengths = []
    for episode in episodes:
        lengths.append(0)
        for row in read_steps(episode, cameras, size):
            dataset.add_frame(row)
            lengths[-1] += 1
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    again = LeRobotDataset(f"playslot_rl/sketchy_{root.name}", root=root, video_backend="pyav")
    if (again.num_episodes, len(again)) != (len(episodes), sum(lengths)):
        raise OutputError(f"{root}: got {len(again)} frames, expected {sum(lengths)}; run the same command again")
    record = {
        "cameras": list(cameras),
        "episodes": [
            {"id": episode.identity, "file": episode.path.name, "task": episode.task, "length": length}
            for episode, length in zip(episodes, lengths, strict=True)
        ],
    }
    write_json(root / META_NAME, record)


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
        source: Sketchy's folder.
        out: folder to make.
        cameras: names out of `CAMERAS`; each is a feature `observation.images.NAME`.
        image_size: side of the frames, pixels.
        storage: `image` (PNG in parquet) or `video` (h264 yuv444p, crf 0).
        tags: which episodes.
        episodes: only so many, for a trial; None takes all.

    Returns:
        `{"train": episodes, "eval": episodes}`.

    Raises:
        ConfigError: an unknown camera.
        DataError: another layout, a missing file or camera, a truncated or damaged record.
        OutputError: `out` is there already, or the disk is full.
    """
    source, out = Path(source).expanduser(), Path(out).expanduser().absolute()
    check_cameras(cameras)
    require_free(out)
    found = find_demonstrations(source, tags)[:episodes]
    train, held_out = split_episodes(len(found))
    with new_folder(out) as temporary, quiet_datasets():
        _write(temporary / "train", found[:train], cameras, image_size, storage)
        if held_out:
            _write(temporary / "eval", found[train:], cameras, image_size, storage)
    return {"train": train, "eval": held_out}
