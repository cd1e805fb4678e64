"""From the journal to a LeRobot v3.0 data set, in one transaction: written under a temporary name, read back, renamed.

A LeRobot data set is unreadable until it is finalised, so none is ever open while episodes are being recorded.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.collectors.image_set import ImageSetWriter, feature, finalising, new_set
from playslot_rl.collectors.journal import CollectionSpec, Journal, RecordedEpisode
from playslot_rl.config.env import in_turn
from playslot_rl.data.metadata import RECORD_NAME, STATS_NAME
from playslot_rl.envs import PROCEDURAL, task_metadata
from playslot_rl.envs.grid_shapes import METADATA
from playslot_rl.errors import OutputError
from playslot_rl.runtime.progress import quiet_datasets
from playslot_rl.storage.atomic import read_json, write_json
from playslot_rl.storage.folders import new_folder

PACKAGES = ("metaworld", "gymnasium-robotics", "mujoco", "gymnasium", "torchrl", "lerobot", "playslot_rl")
VIDEO_ERROR = 2.0  # mean difference [0, 255] that h264 in yuv444p may make
METADATA_ROWS = 200  # episodes in a row group of the episodes' metadata
FREE_BYTES = 16 * 2**20  # less free space than this after a failed export is reported as a full disk


def repo_id(spec: CollectionSpec) -> str:
    return f"playslot_rl/{spec.env.full_name}_{spec.policy}"


def features(spec: CollectionSpec, state_dim: int) -> dict[str, dict[str, Any]]:
    size = spec.env.image_size
    axes = [f"action_{i}" for i in range(spec.env.action_dim)]
    return {
        keys.FEATURE_IMAGE: feature(spec.storage, size, size, 3),
        keys.FEATURE_STATE: feature("float32", state_dim),
        keys.FEATURE_ACTION: feature("float32", spec.env.action_dim, names=axes),
        keys.FEATURE_REWARD: feature("float32", 1),
        keys.FEATURE_SUCCESS: feature("bool", 1),
        keys.FEATURE_DONE: feature("bool", 1),
        keys.FEATURE_SEED: feature("int64", 1),
        keys.FEATURE_LAST: feature("bool", 1),
    }


def columns(episode: RecordedEpisode) -> dict[str, npt.NDArray[Any]]:
    """LeRobot features of an episode, (T + 1, ...): T transitions, then the last observation, whose action is padding.

    Reward, success and done of row t belong to the step from frame t to t + 1; done stays true on the last observation.
    """
    steps = len(episode.actions)
    index = np.arange(steps + 1)
    return {
        keys.FEATURE_IMAGE: episode.frames,
        keys.FEATURE_STATE: episode.states,
        keys.FEATURE_ACTION: np.concatenate([episode.actions, np.zeros_like(episode.actions[:1])]),
        keys.FEATURE_REWARD: np.append(episode.rewards, np.float32(0.0))[:, None],
        keys.FEATURE_SUCCESS: np.append(episode.success, episode.success[-1])[:, None],
        keys.FEATURE_DONE: (index >= steps - 1)[:, None],
        keys.FEATURE_SEED: np.full((steps + 1, 1), episode.seed, np.int64),
        keys.FEATURE_LAST: (index == steps)[:, None],
    }


def _write(root: Path, spec: CollectionSpec, journal: Journal) -> list[dict[str, Any]]:
    """Write and finalise the data set at `root`; returns a record of each episode."""
    metadata = METADATA if spec.env.name in PROCEDURAL else task_metadata(spec.env)
    tasks = list(spec.env.sentences)
    fps = max(1, round(metadata["control_hz"] / spec.env.frame_skip))
    stated = features(spec, journal.read(0).states.shape[1])
    # LeRobot's 10 makes a row group of some 150 columns every ten episodes, all in memory and in the footer.
    dataset = new_set(repo_id(spec), root, fps, spec.env.name, stated, metadata_buffer_size=METADATA_ROWS)
    if tasks:
        dataset.meta.save_episode_tasks(tasks)  # `task_index` is in their order, whichever come
    write = _write_video if spec.storage == "video" else _write_images
    records = []
    with finalising(dataset):
        for episode in write(dataset, journal, tasks or [metadata["task"]]):
            solved = bool(episode.success.any())
            steps = int(episode.success.argmax()) + 1 if solved else None
            outcome = {"seed": episode.seed, "success": solved, "steps_to_success": steps, "redrawn": episode.redrawn}
            records.append(outcome)
    stats = read_json(root / STATS_NAME)  # LeRobot puts features in an order that changes from one process to the next
    write_json(root / STATS_NAME, {name: stats[name] for name in dataset.meta.features if name in stats})
    return records


def _write_images(dataset: Any, journal: Journal, tasks: Sequence[str]) -> Iterator[RecordedEpisode]:
    """The journal's PNGs go into the data set as they are."""
    with contextlib.closing(ImageSetWriter(dataset.meta, dataset.root, tasks[0])) as writer:
        for index in range(journal.spec.episodes):
            episode, images = journal.read_with_images(index)
            values = columns(episode)
            frames = values.pop(keys.FEATURE_IMAGE)
            writer.add(values, frames, images, tasks[in_turn(episode.seed, len(tasks))])
            yield episode


def _write_video(dataset: Any, journal: Journal, tasks: Sequence[str]) -> Iterator[RecordedEpisode]:
    """LeRobot encodes."""
    for index in range(journal.spec.episodes):
        episode = journal.read(index)
        values, task = columns(episode), tasks[in_turn(episode.seed, len(tasks))]
        for t in range(len(episode.frames)):
            dataset.add_frame({name: column[t] for name, column in values.items()} | {"task": task})
        dataset.save_episode()
        yield episode


def _check(root: Path, spec: CollectionSpec, journal: Journal) -> None:
    """Read the data set back; an OutputError where it does not hold what was recorded."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata(repo_id(spec), root=root)
    got, expected = (meta.total_episodes, meta.total_frames), (spec.episodes, spec.episodes * (spec.steps + 1))
    if got != expected:
        raise OutputError(f"{root}: got {got} episodes and frames, expected {expected}; run the same command again")
    if spec.storage == "image":
        _check_images(root, spec, journal)
    else:
        _check_video(root, spec, journal)


def _check_images(root: Path, spec: CollectionSpec, journal: Journal) -> None:
    """Every row against the journal: the PNG byte for byte, and what else an episode is known by."""
    stored = _stored_rows(root)
    for index in range(spec.episodes):
        episode, images = journal.read_with_images(index, decode=False)
        for t, image in enumerate(images):
            row = next(stored, None)
            place = index * (spec.steps + 1) + t
            want = {"index": place, "episode_index": index, keys.FEATURE_SEED: episode.seed}
            if row is None or row[keys.FEATURE_IMAGE]["bytes"] != image or any(row[k] != v for k, v in want.items()):
                raise OutputError(
                    f"{root}: got another row {t} of episode {index} than was recorded, expected the same; "
                    "run the same command again"
                )
    if next(stored, None) is not None:
        raise OutputError(f"{root}: got more rows than were recorded, expected none; run the same command again")


def _stored_rows(root: Path) -> Iterator[dict[str, Any]]:
    from pyarrow import parquet

    columns = [keys.FEATURE_IMAGE, "index", "episode_index", keys.FEATURE_SEED]
    for path in sorted((root / "data").rglob("*.parquet")):
        with parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(1024, columns=columns):
                yield from batch.to_pylist()


def _check_video(root: Path, spec: CollectionSpec, journal: Journal) -> None:
    """Each stored episode's last frame; decoding all of them costs more than recording did."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(repo_id(spec), root=root, video_backend="pyav")
    if len(dataset) != spec.episodes * (spec.steps + 1):
        raise OutputError(f"{root}: got {len(dataset)} rows, expected one a frame; run the same command again")
    for index in range(spec.episodes):
        stored = dataset[index * (spec.steps + 1) + spec.steps][keys.FEATURE_IMAGE].numpy()
        frame: npt.NDArray[Any] = np.rint(stored.transpose(1, 2, 0) * 255)
        error = float(np.abs(frame - journal.read(index).frames[-1]).mean())
        if error > VIDEO_ERROR:
            raise OutputError(
                f"{root}: got frames of episode {index} that differ from the recorded ones by {error:.1f}, "
                f"expected at most {VIDEO_ERROR}; run the same command again"
            )


def export(journal: Journal, out: Path) -> None:
    """Make the LeRobot data set `out` from a complete journal. A kill leaves `out` whole or not there.

    Raises:
        OutputError: full disk, a damaged journal, or a data set that reads back otherwise.
    """
    spec = journal.spec
    try:
        with new_folder(out, create=False) as temporary, quiet_datasets():
            records = _write(temporary, spec, journal)
            _check(temporary, spec, journal)
            record = {
                "spec": spec.to_dict(),
                "success_rate": sum(r["success"] for r in records) / len(records),
                "redrawn": sum(r["redrawn"] for r in records),
                "versions": {name: version(name) for name in PACKAGES},
                "episodes": records,
            }
            write_json(temporary / RECORD_NAME, record)
    except Exception as error:
        # LeRobot swallows errors of writing images and fails later with others.
        if isinstance(error, OutputError) or shutil.disk_usage(out.parent).free >= FREE_BYTES:
            raise
        raise OutputError(
            f"cannot write {out}: the disk is full, expected free space; free some, the same command carries on"
        ) from error
