"""Reading LeRobot data sets that others wrote."""

from __future__ import annotations

import errno
import json
import multiprocessing
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from foreign import LENGTHS, foreign_frames, write_foreign

from playslot_rl.data.cache import build_once, cache_folder
from playslot_rl.data.source import open_sources
from playslot_rl.data.views import RowView
from playslot_rl.errors import DataError, OutputError


def one_line(caught: pytest.ExceptionInfo[Any]) -> bool:
    return "\n" not in str(caught.value)


def test_frames_actions_and_episodes_of_an_image_data_set(foreign_images: Path, tmp_path: Path) -> None:
    source = open_sources(foreign_images, cache=tmp_path)
    assert np.array_equal(source.frames, np.concatenate(foreign_frames()))
    assert source.lengths.tolist() == list(LENGTHS)
    assert source.starts.tolist() == [0, 5, 8]
    assert source.actions is not None
    assert source.actions[5:8].tolist() == [[0, 0], [1, -1], [2, -2]]
    assert source.seeds is None
    assert (source.fps, source.task, source.camera) == (10.0, "push", "observation.images.top")
    assert isinstance(source.frames, np.memmap)
    assert source.pixels([[0, 1]]).shape == (1, 2, 3, 32, 32)
    assert source.pixels([0]).dtype == torch.uint8


@pytest.mark.parametrize("kind", ["images", "video"])
def test_frames_equal_those_of_lerobot(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root: Path = request.getfixturevalue(f"foreign_{kind}")
    camera = "observation.images.top"
    source = open_sources(root, camera, tmp_path)
    reference = LeRobotDataset("me/foreign", root=root, video_backend="pyav")
    assert len(reference) == len(source.frames)
    for row in range(len(reference)):
        frame = (reference[row][camera] * 255).round().to(torch.uint8)
        assert torch.equal(source.pixels(row), frame)


def test_lossless_video_is_close_to_what_was_recorded(foreign_video: Path, tmp_path: Path) -> None:
    source = open_sources(foreign_video, "observation.images.side", tmp_path)
    error = source.frames[:].astype(float) - np.concatenate(foreign_frames(64))
    assert np.abs(error).mean() < 2


def test_the_second_opening_decodes_nothing(
    foreign_images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from playslot_rl.data import frame_build as module
    from playslot_rl.data.contents import Contents

    first = open_sources(foreign_images, cache=tmp_path)
    monkeypatch.setattr(module, "rgb_frames", None)
    monkeypatch.setattr(Contents, "file_hash", None)
    second = open_sources(foreign_images, cache=tmp_path)
    assert np.array_equal(first.frames, second.frames)
    assert first.fingerprint == second.fingerprint


def test_the_fingerprint_follows_the_content_not_the_place(foreign_images: Path, damaged: Path, tmp_path: Path) -> None:
    one, copy = (open_sources(root, cache=tmp_path / "cache") for root in (foreign_images, damaged))
    assert one.fingerprint == copy.fingerprint
    assert len(list((tmp_path / "cache" / "frames").glob("[0-9a-f]*"))) == 1
    other = write_foreign(tmp_path / "other", "image", size=64)
    assert open_sources(other, cache=tmp_path / "cache").fingerprint != one.fingerprint


def test_the_fingerprint_follows_videos_wherever_their_template_puts_them(foreign_video: Path, tmp_path: Path) -> None:
    top, side = (f"observation.images.{name}" for name in ("top", "side"))
    root = Path(shutil.copytree(foreign_video, tmp_path / "set"))
    info = root / "meta" / "info.json"
    elsewhere = {"video_path": "clips/chunk-{chunk_index:03d}/{video_key}/file-{file_index:03d}.mp4"}
    info.write_text(json.dumps(json.loads(info.read_text()) | elsewhere))
    for camera in (top, side):
        (root / "clips" / "chunk-000").mkdir(parents=True, exist_ok=True)
        shutil.move(root / "videos" / camera / "chunk-000", root / "clips" / "chunk-000" / camera)
    before = [open_sources(root, camera, tmp_path, buffer=9).fingerprint for camera in (top, side)]
    with next((root / "clips" / "chunk-000" / top).iterdir()).open("ab") as file:
        file.write(bytes(64))
    after = [open_sources(root, camera, tmp_path, buffer=9).fingerprint for camera in (top, side)]
    assert after[0] != before[0]
    assert after[1] == before[1]


def test_the_data_set_is_left_untouched(foreign_images: Path, tmp_path: Path) -> None:
    before = sorted((str(path), path.stat().st_mtime_ns) for path in foreign_images.rglob("*"))
    open_sources(foreign_images, cache=tmp_path)
    assert sorted((str(path), path.stat().st_mtime_ns) for path in foreign_images.rglob("*")) == before
    with pytest.raises(DataError, match="inside the data set"):
        open_sources(foreign_images, cache=foreign_images / "cache")


def test_several_data_sets_are_read_as_one(
    foreign_images: Path, damaged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DataError, match=r"got the frames of .* twice"):
        open_sources(f"{foreign_images}, {damaged}", cache=tmp_path / "cache")
    with (damaged / "meta" / "info.json").open("a") as info:
        info.write("\n")
    both = open_sources(f"{foreign_images}, {damaged}", cache=tmp_path / "cache")
    doubles = f"note: {damaged}: 3 of its 3 episodes have actions of {foreign_images}'s, and count twice"
    assert doubles in capsys.readouterr().err
    frames = np.concatenate(foreign_frames())
    assert isinstance(both.frames, RowView)
    assert both.frames.shape == (30, 32, 32, 3)
    assert both.starts.tolist() == [0, 5, 8, 15, 20, 23]
    rows = np.array([[14, 15], [29, 0]])
    assert np.array_equal(both.frames[rows], np.concatenate([frames, frames])[rows])
    assert np.array_equal(both.frames[13:17], np.concatenate([frames, frames])[13:17])
    assert np.array_equal(both.frames[-1], frames[-1])
    with pytest.raises(IndexError):
        both.frames[30]
    assert both.actions is not None
    assert both.fingerprint != open_sources(damaged, cache=tmp_path / "cache").fingerprint


def test_frames_of_another_size_are_refused_or_resized(
    foreign_images: Path, foreign_video: Path, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=r"got frames of 32x32 .*, expected 64x64") as caught:
        open_sources(foreign_images, cache=tmp_path, image_size=64)
    assert one_line(caught)
    assert open_sources(foreign_images, cache=tmp_path, image_size=16, resize=True).image_size == (16, 16)
    with pytest.raises(DataError, match="expected 32x32 as in"):
        open_sources([foreign_images, foreign_video], "observation.images.top", tmp_path)


def test_an_unknown_camera_lists_the_cameras(foreign_images: Path, foreign_video: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data\.camera=wrist: .*expected one of: observation\.images\.top$"):
        open_sources(foreign_images, "wrist", tmp_path)
    with pytest.raises(DataError, match=r"got 2 cameras \(observation\.images\.top, observation\.images\.side\)"):
        open_sources(foreign_video, "", tmp_path)


def edited_info(root: Path, text: str = "") -> None:
    path = root / "meta" / "info.json"
    path.write_text(text or json.dumps(json.loads(path.read_text()) | {"codebase_version": "v2.1"}))


def cut(root: Path, folder: str) -> None:
    path = next((root / folder).rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-20])


def another_file_of_rows(root: Path) -> None:
    path = next((root / "data").rglob("*.parquet"))
    shutil.copy(path, path.with_name("file-001.parquet"))


def frame_that_is_none(root: Path, content: bytes | None = b"no picture") -> None:
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[7]["observation.images.top"]["bytes"] = content
    pq.write_table(type(table).from_pylist(rows, schema=table.schema), path)


def cut_videos(root: Path) -> None:
    for path in root.rglob("*.mp4"):
        path.write_bytes(path.read_bytes()[:200])


def later_episode(root: Path) -> None:
    path = next((root / "meta" / "episodes").rglob("*.parquet"))
    table = pq.read_table(path)
    name = "videos/observation.images.top/from_timestamp"
    later = pa.array([0.0, 0.5, 3.0], table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), name, later), path)


FAULTS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "gone": ("images", shutil.rmtree, r"no such folder, expected a LeRobot data set"),
    "an empty folder": ("images", lambda root: (shutil.rmtree(root), root.mkdir()), r"got no meta/info\.json"),  # type: ignore[dict-item]
    "half an info file": ("images", partial(edited_info, text="{"), "damaged"),
    "a list for info": ("images", partial(edited_info, text="[]"), "damaged"),
    "hardly any info": ("images", partial(edited_info, text='{"codebase_version": "v3.0"}'), "damaged"),
    "an older format": ("images", edited_info, "got LeRobot format v2.1"),
    "no rows": ("images", lambda root: shutil.rmtree(root / "data"), "never finalised, or is truncated"),
    "half its rows": ("images", partial(cut, folder="data"), "never finalised, or is truncated"),
    "no episodes": ("images", lambda root: shutil.rmtree(root / "meta/episodes"), "never finalised, or is truncated"),
    "half its episodes": ("images", partial(cut, folder="meta/episodes"), "never finalised, or is truncated"),
    "rows of nobody": ("images", another_file_of_rows, "got 30 rows and 3 episodes of 15 frames, expected 15"),
    "no picture": ("images", frame_that_is_none, r"a frame of observation\.images\.top cannot be decoded"),
    "a picture's name": ("images", partial(frame_that_is_none, content=None), "row 7, .*: got no more than"),
    "half a video": ("video", cut_videos, r"cannot decode the frame at 0\.000 s"),
    "a video too short": ("video", later_episode, r"at 3\.000 s \(it ends too early\)"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_data_set_is_refused_and_leaves_no_cache(
    fault: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    kind, damage, message = FAULTS[fault]
    root = Path(shutil.copytree(request.getfixturevalue(f"foreign_{kind}"), tmp_path / "set"))
    damage(root)
    with pytest.raises(DataError, match=message) as caught:
        open_sources(root, "observation.images.top", tmp_path / "cache")
    assert one_line(caught)
    assert not list((tmp_path / "cache").rglob("*.npy"))


def test_no_name_of_a_data_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"data\.root"):
        open_sources("", cache=tmp_path / "cache")


def test_an_unfinalised_data_set_is_refused(tmp_path: Path) -> None:
    process = multiprocessing.get_context("fork").Process(target=write_unfinalised, args=(tmp_path / "set",))
    process.start()
    process.join()
    with pytest.raises(DataError, match="never finalised"):
        open_sources(tmp_path / "set", cache=tmp_path / "cache")


def write_unfinalised(root: Path) -> None:
    write_foreign(root, "image", die=True)


def test_a_full_disk_leaves_no_cache(foreign_images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(OutputError, match="the disk is full"):
            open_sources(foreign_images, cache=tmp_path)
    assert not list(tmp_path.rglob("*.npy"))
    assert len(open_sources(foreign_images, cache=tmp_path).frames) == 15


def test_a_damaged_cache_says_what_to_delete(foreign_images: Path, tmp_path: Path) -> None:
    open_sources(foreign_images, cache=tmp_path)
    path = next(tmp_path.rglob("frames.npy"))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(DataError, match=f"delete {path.parent}"):
        open_sources(foreign_images, cache=tmp_path)


@pytest.mark.integration
def test_a_cache_is_built_once_by_several_processes(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=build_slowly, args=(tmp_path,)) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * 4
    assert (tmp_path / "log").read_text() == "built\n"
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == ["x"]


def build_slowly(folder: Path) -> None:
    import time

    def build(temporary: Path) -> None:
        time.sleep(0.1)
        (temporary / "x").write_text("x")
        with (folder / "log").open("a") as file:
            file.write("built\n")

    build_once(folder / "made", build)


def test_the_cache_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PLAYSLOT_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    assert cache_folder("elsewhere") == Path("elsewhere")
    monkeypatch.delenv("PLAYSLOT_CACHE")
    assert cache_folder() == Path.home() / ".cache" / "playslot_rl"
