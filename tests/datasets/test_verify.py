"""verify: silent about what LeRobot and we write, and a line for every way to break it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import CAMERA, EPISODES, ROWS, edit_column, edit_json, keep_rows, put, truncate

from playslot_rl.datasets.verify import verify

Break = Callable[[Path], None]


@pytest.mark.parametrize("kind", ["images", "video", "ours"])
def test_a_whole_data_set_is_sound(kind: str, request: pytest.FixtureRequest) -> None:
    result = verify(request.getfixturevalue(kind))
    assert (result.errors, result.warnings) == ((), ())
    assert result.ok
    assert (result.episodes, result.frames) == ((2, 8) if kind == "ours" else (3, 15))
    assert len(result.fingerprint) == 32
    assert set(json.loads(result.to_json())) >= {"ok", "errors", "episodes", "frames", "fingerprint"}


def test_the_data_set_is_left_untouched(images: Path) -> None:
    before = sorted((str(path), path.stat().st_mtime_ns) for path in images.rglob("*"))
    verify(images)
    assert sorted((str(path), path.stat().st_mtime_ns) for path in images.rglob("*")) == before


def info(**changes: Any) -> Break:
    return lambda root: edit_json(root, "meta/info.json", lambda content: content.update(changes))


def column(file: str, name: str, number: int, value: Any) -> Break:
    return lambda root: edit_column(root, file, name, put(number, value))


def corrupt_png(root: Path) -> None:
    def change(cells: list[Any]) -> None:
        cells[6]["bytes"] = cells[6]["bytes"][:60] + b"\0" * 40 + cells[6]["bytes"][100:]

    edit_column(root, ROWS, CAMERA, change)


def other_png(root: Path) -> None:
    edit_column(root, ROWS, CAMERA, lambda cells: cells[6].update(bytes=cells[0]["bytes"]))


def small_png(root: Path) -> None:
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "PNG")
    edit_column(root, ROWS, CAMERA, lambda cells: cells[3].update(bytes=buffer.getvalue()))


def stale_shard(root: Path) -> None:
    shutil.copy(root / ROWS, root / "data/chunk-000/file-001.parquet")


def stats(name: str, key: str, value: Any) -> Break:
    return lambda root: edit_json(root, "meta/stats.json", lambda content: content[name].update({key: value}))


def moved(root: Path) -> None:
    (root / ROWS).rename(root / "data/chunk-000/file-007.parquet")


BREAKS: dict[str, tuple[Break, str]] = {
    "truncated rows": (lambda root: truncate(root / ROWS), "file-000.parquet: cannot be read"),
    "truncated metadata": (lambda root: truncate(root / EPISODES), "file-000.parquet: cannot be read"),
    "missing rows": (lambda root: (root / ROWS).unlink(), "got no such file, expected rows"),
    "missing info": (lambda root: (root / "meta/info.json").unlink(), "got no meta/info.json"),
    "damaged info": (lambda root: truncate(root / "meta/info.json"), "info.json: got JSONDecodeError"),
    "missing tasks": (lambda root: (root / "meta/tasks.parquet").unlink(), "expected the tasks in words"),
    "missing statistics": (lambda root: (root / "meta/stats.json").unlink(), "stats.json: got no such file"),
    "format 2.1": (info(codebase_version="v2.1"), r"got LeRobot format v2.1, expected v3.0; convert it"),
    "frame count": (info(total_frames=16), "got total_frames 16, but the files hold 15"),
    "episode count": (info(total_episodes=4), "got total_episodes 4, but the files hold 3"),
    "task count": (info(total_tasks=2), "got total_tasks 2, but the files hold 1"),
    "rate": (info(fps=20), "got timestamp 0.1 at frame 1|got timestamp .* expected"),
    "rows cut off": (lambda root: keep_rows(root, ROWS, 13), "episode 2: got 5 rows, expected 7"),
    "an episode's rows gone": (lambda root: keep_rows(root, ROWS, 8), "episode 2: got no rows, expected 7"),
    "an episode's metadata gone": (lambda root: keep_rows(root, EPISODES, 2), "episode 2: got rows, but no row in"),
    "shifted index": (column(ROWS, "index", 4, 5), r"row 4: got index 5, expected 4 \(and 0 more"),
    "shifted frame_index": (column(ROWS, "frame_index", 6, 2), "episode 1: got frame_index"),
    "shifted episode_index": (column(ROWS, "episode_index", 4, 1), "episode 0: got 4 rows, expected 5"),
    "unknown task_index": (column(ROWS, "task_index", 2, 3), r"got task_index \[3\], expected one of meta/tasks"),
    "timestamp": (column(ROWS, "timestamp", 7, 0.25), "episode 1: got timestamp 0.25 at frame 2, expected 0.2"),
    "dataset_from_index": (column(EPISODES, "dataset_from_index", 1, 6), r"episode 1: got dataset_from_index"),
    "dataset_to_index": (column(EPISODES, "dataset_to_index", 1, 9), r"\(5, 9\), expected \(5, 8\)"),
    "episode's index": (column(EPISODES, "episode_index", 2, 3), r"got episodes \[0, 1, 3\]"),
    "length": (column(EPISODES, "length", 0, 4), "episode 0: got 5 rows, expected 4"),
    "tasks": (column(EPISODES, "tasks", 0, ["pull"]), r"got tasks \['push'\] in its rows, expected \['pull'\]"),
    "place of rows": (column(EPISODES, "data/file_index", 0, 1), "file-001.parquet: got no such file, expected rows"),
    "moved rows": (moved, "file-007.parquet: got a file that no episode names"),
    "stale shard": (stale_shard, "file-001.parquet: got a file that no episode names"),
    "corrupt PNG": (corrupt_png, "row 6, observation.images.top: cannot be decoded"),
    "PNG of another size": (small_png, r"row 3, .*: got \(16, 16\), expected \(32, 32\)"),
    "another PNG": (other_png, "episode 1: got .* of observation.images.top that the frames"),
    "not a number": (column(ROWS, "action", 3, [float("nan"), 0.0]), "episode 0: got a value of action that is NaN"),
    "changed action": (column(ROWS, "action", 3, [9.0, 0.0]), "episode 0: got .* of action that the frames and rows"),
    "mean": (stats("action", "mean", [7.0, 7.0]), "stats.json: got mean of action"),
    "std": (stats("action", "std", [7.0, 7.0]), "stats.json: got std of action"),
    "min": (stats("action", "min", [-7.0, -7.0]), "stats.json: got min of action"),
    "max": (stats("action", "max", [7.5, 7.5]), "stats.json: got max of action"),
    "count": (stats("action", "count", [14]), "stats.json: got count of action"),
    "statistics that are NaN": (stats("action", "mean", [float("nan"), 0.0]), "stats.json: got mean of action"),
    "camera's mean": (stats(CAMERA, "mean", [[[0.9]]] * 3), f"stats.json: got mean of {CAMERA}"),
}  # fmt: skip


@pytest.mark.parametrize("damage", BREAKS)
def test_damage_is_noticed(damage: str, broken: Path) -> None:
    import re

    do, message = BREAKS[damage]
    do(broken)
    result = verify(broken)
    assert not result.ok
    assert result.fingerprint == ""
    assert any(re.search(message, line) for line in result.errors), result.errors
    assert all("\n" not in line for line in result.errors)


VIDEO_BREAKS: dict[str, tuple[Break, str]] = {
    "missing": (lambda root: next(root.glob("videos/*top/*/*.mp4")).unlink(), "mp4: got no such file, expected"),
    "cut off": (lambda root: truncate(next(root.glob("videos/*top/*/*.mp4")), 0.7), "cannot decode the frame"),
    "stale": (lambda root: shutil.copy(next(root.glob("videos/*top/*/*.mp4")), root / "videos" / CAMERA / "old.mp4"),
              "old.mp4: got a file that no episode names"),
    "from_timestamp": (column(EPISODES, f"videos/{CAMERA}/from_timestamp", 1, 0.9), "episode 1: got .* from 0.9 to"),
    "to_timestamp": (column(EPISODES, f"videos/{CAMERA}/to_timestamp", 2, 9.0), "to 9.0 s, expected 7 frames"),
    "stated size": (lambda root: edit_json(root, "meta/info.json",
                    lambda info: info["features"][CAMERA].update(shape=[32, 32, 3])), r"got frames of \(64, 64\)"),
    "camera's mean": (stats(CAMERA, "mean", [[[0.9]]] * 3), f"stats.json: got mean of {CAMERA}"),
}  # fmt: skip


@pytest.mark.parametrize("damage", VIDEO_BREAKS)
def test_damage_of_videos_is_noticed(damage: str, broken_video: Path) -> None:
    import re

    do, message = VIDEO_BREAKS[damage]
    do(broken_video)
    result = verify(broken_video)
    assert any(re.search(message, line) for line in result.errors), result.errors


def test_our_record_has_to_agree(ours: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(ours, tmp_path / "copy"))
    edit_json(copy, "meta/playslot.json", lambda record: record["episodes"][1].update(seed=77))
    assert "got seed 77 of episode 1, expected 1" in verify(copy).errors[0]
    edit_json(copy, "meta/playslot.json", lambda record: record["episodes"].pop())
    assert "got 1 episodes, but the rows hold 2" in verify(copy).errors[0]


def test_a_missing_folder_is_a_result_and_not_an_error(tmp_path: Path) -> None:
    result = verify(tmp_path / "nothing")
    assert not result.ok
    assert "got no such folder" in result.errors[0]


def test_many_faults_of_one_kind_are_counted(broken: Path) -> None:
    import pyarrow.parquet as pq

    edit_column(broken, ROWS, CAMERA, lambda cells: [cell.update(bytes=b"nothing") for cell in cells])
    assert len(pq.ParquetFile(broken / ROWS).read()) == 15
    lines = [line for line in verify(broken).errors if "decode" in line or "more of this kind" in line]
    assert len(lines) == 6
    assert lines[-1] == "damaged frame: and 10 more of this kind"


def test_statistics_are_those_of_lerobot(images: Path) -> None:
    from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats, sample_indices

    from playslot_rl.datasets.statistics import Aggregate, of_frames, of_numbers, sampled

    generator = np.random.default_rng(0)
    for length in (1, 2, 99, 100, 101, 500, 5000):
        assert sampled(length) == sample_indices(length)
    numbers = generator.normal(3, 2, (400, 3)).astype(np.float32)
    theirs, mine = get_feature_stats(numbers, axis=0, keepdims=False), of_numbers(numbers)
    assert theirs.keys() == mine.keys()
    for key, value in theirs.items():
        np.testing.assert_allclose(mine[key], value, atol=0.02 if key.startswith("q") else 1e-4)
    frames = generator.integers(0, 256, (30, 8, 8, 3), np.uint8)
    theirs = get_feature_stats(frames.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
    mine = of_frames(list(frames))
    for key, value in theirs.items():
        expected = value if key == "count" else value[0] / 255
        assert mine[key].shape == expected.shape
        np.testing.assert_allclose(mine[key], expected, atol=1e-3)
    parts = [{"a": of_numbers(numbers[:100])}, {"a": of_numbers(numbers[100:])}]
    total = Aggregate()
    for part in parts:
        total.add(part)
    for key, value in aggregate_stats(parts)["a"].items():
        np.testing.assert_allclose(total.result()["a"][key], value)


def test_statistics_are_read_a_few_episodes_at_a_time(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.data import tables

    sizes: list[tuple[int, bool]] = []
    real = tables.episodes_of

    def episodes(path: Path, table: Any, problems: Any) -> Any:
        sizes.append((len(table), any(name.startswith("stats/") for name in table.column_names)))
        return real(path, table, problems)

    monkeypatch.setattr(tables, "episodes_of", episodes)
    monkeypatch.setattr(tables, "EPISODES_AT_ONCE", 2)
    assert verify(images).ok
    with_statistics = [size for size, there in sizes if there]
    assert sum(with_statistics) == 3
    assert max(with_statistics) <= 2
