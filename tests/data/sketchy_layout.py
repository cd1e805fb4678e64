"""Files in Sketchy's published layout, written for tests: metadata.sqlite and one TFRecord file an episode."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from playslot_rl.datasets.sketchy import example_class, masked_crc

LENGTHS = (4, 6, 3, 5, 4)
SIZE = (60, 96)
"""Height and width of the pictures: a tenth of the real ones."""
CAMERAS = ("pixels/basket_front_left", "pixels/basket_front_right", "pixels/basket_back_left")


def frame_record(data: bytes) -> bytes:
    """Length, checksums and data, as TFRecord wants them."""
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc(length)) + data + struct.pack("<I", masked_crc(data))


def example(features: Mapping[str, Any]) -> bytes:
    """A serialised tf.train.Example."""
    message = example_class()()
    for name, value in features.items():
        feature = message.features.feature[name]
        if isinstance(value, bytes):
            feature.bytes_list.value.append(value)
        elif np.asarray(value).dtype.kind == "i":
            feature.int64_list.value.extend(np.asarray(value).ravel().tolist())
        else:
            feature.float_list.value.extend(np.asarray(value).ravel().tolist())
    data: bytes = message.SerializeToString()
    return data


def jpeg(colour: Sequence[int]) -> bytes:
    """A plain picture, so that resizing and compression keep its colour."""
    buffer = io.BytesIO()
    Image.fromarray(np.full((*SIZE, 3), colour, np.uint8)).save(buffer, format="JPEG", quality=95)
    return buffer.getvalue()


def colour_of(episode: int, step: int, camera: int) -> tuple[int, int, int]:
    """What each picture shows."""
    return 40 * episode + 20, 30 * step + 20, 100 * camera + 20


def timestep(episode: int, step: int, cameras: Sequence[str] = CAMERAS) -> dict[str, Any]:
    """The features that matter, and some that do not."""
    return {
        "actions": np.arange(7) + step + 0.5,
        "sawyer/tcp/pose": np.arange(7) * 0.1,
        "gripper/joints/angle": np.array([0.25]),
        "gripper/grasp": np.array([step % 2]),
        "wrist/force": np.zeros(3),
        **{name: jpeg(colour_of(episode, step, number)) for number, name in enumerate(cameras)},
    }


def name_of(episode: int) -> str:
    """File name of an episode; the order of names is that of the numbers."""
    return f"1000{episode}_b615a417-ce34"


def write_sketchy(root: Path, cameras: Sequence[str] = CAMERAS) -> Path:
    """Five demonstrations of two tasks in a subfolder, and one episode of an agent that no demonstration tag names."""
    (root / "episodes").mkdir(parents=True)
    database = sqlite3.connect(root / "metadata.sqlite")
    database.executescript(
        "CREATE TABLE Episodes (EpisodeId VARCHAR PRIMARY KEY, TaskId VARCHAR, DataPath VARCHAR, Timestamp INTEGER, "
        "EpisodeType VARCHAR); CREATE TABLE EpisodeTags (EpisodeId VARCHAR, Tag VARCHAR, PRIMARY KEY (EpisodeId, Tag));"
    )
    for episode in reversed(range(len(LENGTHS) + 1)):
        demo = episode < len(LENGTHS)
        task = "lift_green" if episode % 2 == 0 else "stack_green_on_red"
        kind = "EPISODE_ROBOT_TELEOPERATION" if demo else "EPISODE_ROBOT_AGENT"
        database.execute("INSERT INTO Episodes VALUES (?, ?, ?, 0, ?)", (str(episode), task, name_of(episode), kind))
        for tag in [f"{task}__demos"] * demo + ["rgb30__all"]:
            database.execute("INSERT INTO EpisodeTags VALUES (?, ?)", (str(episode), tag))
        steps = LENGTHS[episode] if demo else 2
        records = [frame_record(example(timestep(episode, step, cameras))) for step in range(steps)]
        (root / "episodes" / name_of(episode)).write_bytes(b"".join(records))
    database.commit()
    database.close()
    return root
