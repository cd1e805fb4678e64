"""`meta/info.json` of a LeRobot v3.0 data set, held to bounds before anything believes it.

Whoever made a data set wrote these numbers, names and paths: they become sizes in memory, names of files and numbers of
loops. What is read here is within bounds, and a path made from it lies below the data set's folder.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from playslot_rl.data.places import checked_template, inside, is_plain
from playslot_rl.errors import DataError

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
WHOLE: Final = ("frame_index", *PLACE)  # columns of whole numbers
REQUIRED: Final = ("timestamp", *WHOLE)

FASTEST: Final = 10_000  # frames a second
MOST: Final = 2**40  # frames, episodes and tasks
LARGEST_VALUE: Final = 2**28  # numbers of a feature in one frame
LARGEST_PICTURE: Final = 2**26  # pixels of a frame: 8192x8192
LONGEST_JSON: Final = 2**28  # bytes
NUMBERS: Final = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64)")  # types of features whose values are numbers
CAMERAS: Final = ("image", "video")
OTHERS: Final = (*CAMERAS, "string", "large_string", "language")


class _BoundsError(ValueError):
    """A value outside its bounds: what was got, and what was expected."""


def json_content(path: Path) -> Any:
    """What a JSON file holds (`parsed`); a ValueError also where it is too long, an OSError where it cannot be read."""
    size = path.stat().st_size
    if size > LONGEST_JSON:
        raise ValueError(f"{size} bytes, expected at most {LONGEST_JSON}")
    return parsed(path.read_bytes())


def read_record(root: Path) -> dict[str, Any] | None:
    """Our own record of the data set at `root`, or None where there is none that can be used."""
    path = root / RECORD_NAME
    try:
        record = json_content(path) if inside(root, path) else {}
        json.dumps(record, allow_nan=False)
        usable = all(isinstance(entry, dict) for entry in [*record["episodes"], *(record.get("sources") or [])])
        spec = record.get("spec") or {}
        numbers = (record.get("success_rate"), (spec.get("env") or {}).get("frame_skip"))
        tables = (spec.get("render") or {}, record.get("versions") or {})
        usable &= all(isinstance(table, dict) for table in tables)
        usable &= all(number is None or isinstance(number, int | float) for number in numbers)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return record if usable else None


def parsed(content: bytes) -> Any:
    """What JSON says, a byte-order mark before it passed over; a ValueError where it is none, or nested too deeply."""
    try:
        values = json.loads(content)
        json.dumps(values, ensure_ascii=False).encode()  # halves of characters could not be printed
    except RecursionError as error:
        raise ValueError("lists in lists without an end") from error
    return values


def damaged(error: BaseException) -> str:
    """The name and the beginning of an error's text, for a message of one line."""
    text = " ".join(str(error).split())[:120]
    return text if isinstance(error, _BoundsError) else f"{type(error).__name__} ({text})"


def clips_hint(root: Path) -> str:
    """Where it is said how plain videos become a data set, as the end of a message; empty where the folder has none."""
    clips = any(path.suffix.lower() == ".mp4" for path in root.iterdir())
    return "; it holds .mp4 files: docs/tutorials/your-own-videos.md makes a data set of them" if clips else ""


def read_info(root: Path) -> dict[str, Any]:
    """`meta/info.json`, after a check of the values that everything else needs.

    Raises:
        DataError: no folder, no such file, damaged, of another format version, or a value outside its bounds.
    """
    if not root.is_dir():
        raise DataError(f"{root}: got no such folder, expected a LeRobot v3.0 data set; check the path")
    path = root / INFO_NAME
    if not path.is_file():
        raise DataError(
            f"{root}: got no {INFO_NAME}, expected a LeRobot v3.0 data set; check the path or pull it again"
            f"{clips_hint(root)}"
        )
    if not inside(root, path):
        raise DataError(f"{path}: got a link out of the data set, expected a file of its own: copy it there")
    try:
        info = json_content(path)
        version = str(info["codebase_version"])
        known = isinstance(info, dict) and isinstance(info["features"], dict)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: got {damaged(error)}, a damaged file, expected LeRobot's metadata; pull or collect it again"
        ) from error
    if not version.startswith("v3."):
        cure = "convert it by LeRobot's convert_dataset_v21_to_v30" if version.startswith("v2") else "see LeRobot"
        raise DataError(f"{root}: got LeRobot format {version[:20]}, expected v3.0; {cure}")
    try:
        if not known:
            raise _BoundsError("features that are no table, expected names and their types")
        _check(info)
    except _BoundsError as error:
        raise DataError(f"{path}: got {error}; mend the file, or pull or collect the data set again") from error
    checked: dict[str, Any] = info
    return checked


def robot_of(info: Mapping[str, Any]) -> str:
    """`robot_type` in one line; empty where there is none."""
    return " ".join(str(info.get("robot_type") or "").split())


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Whether a camera feature is a depth map, whose values are not scaled to [0, 1]."""
    info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def stated_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """(H, W) that a camera feature states, whichever way round its shape is."""
    shape, names = feature["shape"], feature.get("names")
    first = names[0] if isinstance(names, list) and names else ""
    channels_first = len(shape) == 3 and (first in ("channel", "channels") or shape[2] not in (1, 3, 4))
    height, width = shape[1:3] if channels_first else shape[:2]
    return int(height), int(width)


def whole(value: Any, low: int, high: int) -> int:
    """A whole number within bounds, else a ValueError; one with a point counts, as pandas gives them."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise _BoundsError(f"{_short(value)}, expected a whole number from {low} to {high}")
    return int(value)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:60]}..."


def _positive(value: Any, high: int) -> bool:
    """Whether this is a number above 0, `high` at most; NaN is none."""
    return not isinstance(value, bool) and isinstance(value, int | float) and 0 < value <= high


def _check(info: Mapping[str, Any]) -> None:
    fps = info.get("fps")
    if not _positive(fps, FASTEST):
        raise _BoundsError(f"fps {_short(fps)}, expected a number above 0, at most {FASTEST}")
    for name in ("total_frames", "total_episodes", "total_tasks"):
        if name in info or name != "total_tasks":
            _named(name, info.get(name), 0, MOST)
    if info.get("chunks_size") is not None:
        _named("chunks_size", info["chunks_size"], 1, 10**6)
    for name in ("data_files_size_in_mb", "video_files_size_in_mb"):
        size = info.get(name)
        if size is not None and not _positive(size, 10**6):
            raise _BoundsError(f"{name} {_short(size)}, expected megabytes above 0, at most {10**6}")
    for name, fields in (("data_path", ()), ("video_path", ("video_key",))):
        if info.get(name) is not None and not checked_template(info[name], fields):
            raise _BoundsError(
                f"{name} {_short(info[name])}, expected a path below the data set's folder of no fields but "
                f"{', '.join(('chunk_index', 'file_index', *fields))}, as in {VIDEO_PATH if fields else DATA_PATH}"
            )
    if not isinstance(info.get("splits") or {}, dict):
        raise _BoundsError(f"splits {_short(info['splits'])}, expected names and ranges of episodes")
    missing = [name for name in REQUIRED if name not in info["features"]]
    if missing:
        raise _BoundsError(f"no feature {', '.join(missing)}, expected {', '.join(REQUIRED)}")
    for name, feature in info["features"].items():
        _check_feature(name, feature)
    try:
        json.dumps(info, allow_nan=False)
    except ValueError as error:
        raise _BoundsError("a value that is NaN or infinite, expected numbers") from error


def _named(name: str, value: Any, low: int, high: int) -> None:
    try:
        whole(value, low, high)
    except ValueError as error:
        raise _BoundsError(f"{name} {error}") from error


def _check_feature(name: str, feature: Any) -> None:
    if not is_plain(name):
        raise _BoundsError(f"the feature's name {_short(name)}, expected one without slashes: folders are named by it")
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        raise _BoundsError(f"feature {name} as {_short(feature)}, expected its dtype and shape")
    dtype, shape = feature["dtype"], feature.get("shape")
    if not isinstance(shape, list) or len(shape) > 8:
        raise _BoundsError(f"shape {_short(shape)} of {name}, expected a list of at most 8 numbers")
    for number in shape:
        _named(f"shape {_short(shape)} of {name}:", number, 1, LARGEST_VALUE)
    camera = dtype in CAMERAS
    if camera and len(shape) not in (2, 3):
        raise _BoundsError(f"shape {_short(shape)} of the camera {name}, expected height, width and channels")
    if math.prod(shape) > LARGEST_VALUE or (camera and math.prod(stated_size(feature)) > LARGEST_PICTURE):
        raise _BoundsError(f"shape {_short(shape)} of {name}, expected at most {LARGEST_VALUE} numbers in a frame")
    index, single = name in WHOLE, shape in ([], [1])
    if name in REQUIRED and not (single and re.fullmatch(r"u?int\d+" if index else r"float\d+", dtype)):
        raise _BoundsError(f"{name} as {_short(dtype)} {_short(shape)}, expected one {'int64' if index else 'float32'}")
    if not isinstance(feature.get("names") or [], list | dict):
        raise _BoundsError(f"names {_short(feature['names'])} of {name}, expected a list")
    for key in ("info", "video_info"):
        if not isinstance(feature.get(key) or {}, dict):
            raise _BoundsError(f"{key} {_short(feature[key])} of {name}, expected names and values")
