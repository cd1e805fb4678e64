"""repair: what is whole comes back, what is lost is named, the damaged data set is kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import (
    CAMERA,
    EPISODES,
    ROWS,
    add_episodes,
    edit_column,
    edit_json,
    frames_of,
    keep_rows,
    killed_while,
    load,
    put,
    truncate,
)

from playslot_rl.datasets.fingerprint import content_fingerprint
from playslot_rl.datasets.repair import repair
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError, OutputError

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them


def create(root: Path, dtype: str = "image", shard_mb: float = 100, size: int = 32) -> Any:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    image = {"dtype": dtype, "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    features = {CAMERA: image, "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}}
    encoder = RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0) if dtype == "video" else None
    dataset = LeRobotDataset.create(
        "me/killed", fps=10, features=features, root=root, use_videos=dtype == "video", rgb_encoder=encoder
    )
    dataset.meta.info.data_files_size_in_mb = shard_mb
    dataset.meta.info.video_files_size_in_mb = shard_mb
    return dataset


def test_a_sound_data_set_is_left_alone(images: Path) -> None:
    result = repair(images)
    assert result.stated is None
    assert result.lines() == [f"{images}: sound, nothing to repair (3 episodes, 15 frames)"]
    assert not list(images.parent.glob("*.damaged"))


def test_killed_while_resuming_it_comes_back_as_it_was(images: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = Path(shutil.copytree(images, tmp_path / "set"))
    before = content_fingerprint(images)
    killed_while(lambda tick: add_episodes(LeRobotDataset.resume("me/foreign", root=root), (4, 6), tick), 3)
    with pytest.raises(Exception, match=r"generating the dataset|(?i:parquet)"):
        load(root)[0]
    assert not verify(root).ok
    result = repair(root)
    assert content_fingerprint(root) == before
    assert np.array_equal(frames_of(root), frames_of(images))
    assert (result.stated, result.verification.episodes) == (5, 3)
    text = "\n".join(result.lines())
    assert "episodes 3, 4: no rows are left of them" in text
    assert "3 of 5 episodes restored, 15 frames" in text
    assert result.damaged == tmp_path / "set.damaged"
    assert not verify(result.damaged).ok


@pytest.mark.parametrize("dtype", ["image", "video"])
def test_killed_before_finalize_all_finished_files_come_back(dtype: str, tmp_path: Path) -> None:
    root = tmp_path / "set"
    lengths = (6, 5, 7, 4)
    size = 32 if dtype == "image" else 64
    # Tiny shards: LeRobot closes one file of rows after another, but not the metadata of episodes.
    killed_while(lambda tick: add_episodes(create(root, dtype, 0.0001, size), lengths, tick, size), 5)
    assert not verify(root).ok
    result = repair(root)
    made = load(root)
    assert 2 <= made.num_episodes <= 4
    assert made.num_episodes == result.verification.episodes
    assert list(made.meta.episodes["length"]) == list(lengths[: made.num_episodes])
    assert made[0]["task"] == "pull"
    generator = np.random.default_rng(1)
    for row in range(len(made)):
        image = generator.integers(0, 256, (size, size, 3), np.uint8)
        error = np.abs(made[row][CAMERA].numpy() - image.transpose(2, 0, 1) / 255).mean()
        assert error < (1e-6 if dtype == "image" else 0.02)
    assert "cannot be read" in "\n".join(result.lost)


def test_killed_in_its_first_file_nothing_can_come_back(tmp_path: Path) -> None:
    root = tmp_path / "set"
    killed_while(lambda tick: add_episodes(create(root), (3,), tick), 2)
    before = sorted(root.rglob("*"))
    with pytest.raises(DataError, match=r"got no whole episode to restore .*cannot be read.*record it again"):
        repair(root)
    assert sorted(root.rglob("*")) == before
    (tmp_path / "set.journal").mkdir()
    with pytest.raises(DataError, match=r"set\.journal holds .*`playslot collect` with the same arguments"):
        repair(root)


def corrupt(root: Path) -> None:
    edit_column(root, ROWS, CAMERA, lambda cells: cells[6].update(bytes=b"\x89PNG nothing"))


CASES: dict[str, tuple[Callable[[Path], object], list[int], str]] = {
    "rows cut off": (lambda root: keep_rows(root, ROWS, 13), [0, 1], "episode 2 .5 rows.: got 5 rows, expected 7"),
    "metadata cut off": (lambda root: truncate(root / EPISODES), [0, 1, 2], "cannot be read"),
    "a damaged frame": (corrupt, [0, 2], "episode 1 .3 rows.: 1 of 3 frames of .* cannot be decoded"),
    "a wrong timestamp": (lambda root: edit_column(root, ROWS, "timestamp", put(1, 9.0)), [1, 2], "got timestamp 9"),
    "counts": (lambda root: edit_json(root, "meta/info.json", lambda i: i.update(total_frames=9)), [0, 1, 2], ""),
    "index": (lambda root: edit_column(root, ROWS, "index", put(4, 40)), [0, 1, 2], ""),
    "statistics": (lambda root: edit_json(root, "meta/stats.json", lambda s: s.pop("action")), [0, 1, 2], ""),
    "no statistics": (lambda root: (root / "meta/stats.json").unlink(), [0, 1, 2], ""),
    "stale shard": (lambda root: shutil.copy(root / ROWS, root / "data/chunk-000/file-001.parquet"), [0, 1, 2],
                    "file-001.parquet: left from another version"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_whole_episodes_are_kept_and_lost_ones_named(case: str, broken: Path, images: Path) -> None:
    import re

    do, kept, message = CASES[case]
    do(broken)
    result = repair(broken)
    whole = content_fingerprint(images).episodes
    assert content_fingerprint(broken).episodes == tuple(whole[i] for i in kept)
    assert len(load(broken)) == sum((5, 3, 7)[i] for i in kept)
    assert bool(message) == bool(result.lost)
    assert re.search(message, "\n".join(result.lost))


def test_a_lost_video_costs_its_episodes(broken_video: Path) -> None:
    next(broken_video.glob("videos/*side/*/*.mp4")).unlink()
    with pytest.raises(DataError, match="no whole episode to restore"):
        repair(broken_video)
    assert not broken_video.with_name("broken.damaged").exists()


def test_our_record_keeps_the_restored_episodes(ours: Path, tmp_path: Path) -> None:
    from playslot_rl import keys

    root = Path(shutil.copytree(ours, tmp_path / "ours"))
    edit_column(root, ROWS, keys.FEATURE_IMAGE, lambda cells: cells[1].update(bytes=b"nothing"))
    repair(root)
    record = json.loads((root / "meta/playslot.json").read_text())
    assert [entry["seed"] for entry in record["episodes"]] == [1]
    assert record["made_by"] == "playslot dataset repair"
    assert record["sources"][0]["spec"]["policy"] == "random"


def test_out_leaves_the_damaged_one_in_place(broken: Path, tmp_path: Path) -> None:
    keep_rows(broken, ROWS, 13)
    with pytest.raises(OutputError, match="expected none; choose another --out"):
        repair(broken, broken)
    result = repair(broken, tmp_path / "new")
    assert verify(tmp_path / "new").ok
    assert not verify(broken).ok
    assert result.damaged is None


def test_a_second_repair_keeps_both_damaged_ones(broken: Path) -> None:
    for _ in range(2):
        edit_json(broken, "meta/info.json", lambda content: content.update(total_frames=1))
        repair(broken)
    assert sorted(path.name for path in broken.parent.glob("broken*")) == [
        "broken",
        "broken.damaged",
        "broken.damaged-2",
    ]


def test_without_metadata_or_of_another_version_it_says_so(broken: Path) -> None:
    edit_json(broken, "meta/info.json", lambda content: content.update(codebase_version="v2.1"))
    with pytest.raises(DataError, match=r"got LeRobot format v2.1, expected v3.0; convert it"):
        repair(broken)
    (broken / "meta/info.json").unlink()
    with pytest.raises(DataError, match=r"got no meta/info\.json"):
        repair(broken)


def test_a_kill_before_the_first_rename_is_no_obstacle(broken: Path, images: Path) -> None:
    shutil.copytree(images, broken.with_name(".broken.repaired"))
    (broken / "meta" / "stats.json").unlink()
    assert repair(broken).damaged == broken.with_name("broken.damaged")
    assert verify(broken).ok
    assert not broken.with_name(".broken.repaired").exists()


def test_a_kill_between_the_two_renames_is_finished_by_the_next_repair(broken: Path, images: Path) -> None:
    shutil.copytree(images, broken.with_name(".broken.repaired"))
    broken.rename(broken.with_name("broken.damaged"))
    assert "nothing to repair" in repair(broken).lines()[0]
    assert verify(broken).ok
