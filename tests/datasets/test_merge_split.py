"""merge and split: every frame equal, in order, none lost, none double; refused otherwise, and nothing half-written."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import CAMERA, ROWS, add_episodes, edit_column, edit_json, frames_of, keep_rows, killed_while, load

from playslot_rl.data.agreement import open_files
from playslot_rl.data.prints import episode_origins
from playslot_rl.datasets import merge as merging
from playslot_rl.datasets.fingerprint import content_fingerprint
from playslot_rl.datasets.info import info
from playslot_rl.datasets.merge import merge
from playslot_rl.datasets.split import by_task, draw, split
from playslot_rl.datasets.verify import verify
from playslot_rl.errors import DataError, OutputError


@pytest.fixture
def other(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A second data set with the features of `images`, another task, and two episodes in two shards."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    images: Path = request.getfixturevalue("images")
    root = tmp_path / "other"
    features = {k: v for k, v in load(images).features.items() if k in (CAMERA, "action")}
    dataset = LeRobotDataset.create("me/other", fps=10, features=features, root=root, use_videos=False)
    dataset.meta.info.data_files_size_in_mb = 0.0001

    class EnoughError(Exception):
        pass

    ticks: list[int] = []

    def tick() -> None:
        ticks.append(1)
        if len(ticks) == 2:
            raise EnoughError

    with pytest.raises(EnoughError):
        add_episodes(dataset, (4, 2), tick)
    dataset.clear_episode_buffer()
    dataset.finalize()
    edit_json(root, "meta/info.json", lambda info: info.update(data_files_size_in_mb=100))
    return root


@pytest.mark.integration
def test_merged_images_are_the_sources_in_order(images: Path, other: Path, tmp_path: Path) -> None:
    result = merge([images, other], tmp_path / "all")
    made = load(tmp_path / "all")
    assert (made.num_episodes, len(made)) == (5, 21) == (result.verification.episodes, result.verification.frames)
    assert np.array_equal(frames_of(tmp_path / "all"), np.concatenate([frames_of(images), frames_of(other)]))
    assert [made[i]["task"] for i in (0, 14, 15, 20)] == ["push", "push", "pull", "pull"]
    assert [int(made[i]["index"]) for i in range(21)] == list(range(21))
    assert [int(made[i]["episode_index"]) for i in (0, 14, 15, 19, 20)] == [0, 2, 3, 4, 4]
    assert made[16]["action"].tolist() == [1, -1]
    parts = content_fingerprint(images).episodes + content_fingerprint(other).episodes
    assert content_fingerprint(tmp_path / "all").episodes == parts


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["video", "av1"])
def test_merged_videos_are_not_encoded_again(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    video: Path = request.getfixturevalue(kind)
    again = Path(shutil.copytree(video, tmp_path / "again"))
    merge([video, again], tmp_path / "all")
    for camera in (CAMERA, "observation.images.side"):
        before = frames_of(video, camera)
        assert np.array_equal(frames_of(tmp_path / "all", camera), np.concatenate([before, before]))
    assert content_fingerprint(tmp_path / "all").episodes == content_fingerprint(video).episodes * 2
    assert len(list((tmp_path / "all").rglob("*.mp4"))) == 2


@pytest.mark.integration
def test_a_merged_set_can_be_resumed_and_merged_again(
    images: Path, other: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    merge([images, other], tmp_path / "all")
    assert "count twice" not in capsys.readouterr().err
    more = LeRobotDataset.resume("me/all", root=tmp_path / "all")
    for _ in range(2):
        more.add_frame({CAMERA: np.zeros((32, 32, 3), np.uint8), "action": np.zeros(2, np.float32), "task": "rest"})
    more.save_episode()
    more.finalize()
    assert verify(tmp_path / "all").errors == ()
    assert merge([tmp_path / "all", images], tmp_path / "more").verification.episodes == 9
    told = f"note: {images}: 3 of its 3 episodes have actions of {tmp_path / 'all'}'s, and count twice"
    assert told in capsys.readouterr().err


@pytest.mark.integration
def test_small_limits_make_several_files(video: Path, images: Path, tmp_path: Path) -> None:
    for source in (video, images):
        small = Path(shutil.copytree(source, tmp_path / f"{source.name}-small"))
        limits = {"data_files_size_in_mb": 1e-4, "video_files_size_in_mb": 1e-4, "chunks_size": 2}
        edit_json(small, "meta/info.json", lambda info, limits=limits: info.update(limits))
        assert merge([small, source], tmp_path / f"{source.name}-all").verification.ok
        assert len(list((tmp_path / f"{source.name}-all" / "data").rglob("*.parquet"))) == 6
        expected = content_fingerprint(source).episodes * 2
        assert content_fingerprint(tmp_path / f"{source.name}-all").episodes == expected
    assert len(list((tmp_path / "video-all").glob("videos/*top/chunk-00[012]/file-00[01].mp4"))) >= 3


@pytest.mark.integration
def test_our_records_are_joined(ours: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(ours, tmp_path / "copy"))
    merge([ours, copy], tmp_path / "all")
    record = json.loads((tmp_path / "all/meta/playslot.json").read_text())
    assert [entry["seed"] for entry in record["episodes"]] == [0, 1, 0, 1]
    assert record["success_rate"] == 0.0
    assert [source["name"] for source in record["sources"]] == [ours.name, "copy"]


def differ(root: Path, key: str, value: object) -> None:
    edit_json(root, "meta/info.json", lambda info: info.update({key: value}))


def test_data_sets_that_do_not_fit_are_refused(
    images: Path, video: Path, ours: Path, broken: Path, tmp_path: Path
) -> None:
    out = tmp_path / "all"
    with pytest.raises(DataError, match=r"got feature observation\.images\.side in only one of it"):
        merge([images, video], out)
    with pytest.raises(DataError, match="got 16 fps, expected 10 as in"):
        merge([images, ours], out)
    with pytest.raises(DataError, match="got 1 data set, expected at least two"):
        merge([images], out)
    with pytest.raises(DataError, match="the same data set twice"):
        merge([images, images.parent / "." / images.name], out)
    with pytest.raises(OutputError, match="expected none; choose another --out"):
        merge([images, broken], images)
    differ(broken, "robot_type", "arm")
    with pytest.raises(DataError, match="got robot_type arm, expected None"):
        merge([images, broken], out)
    differ(broken, "robot_type", None)
    edit_json(broken, "meta/info.json", lambda info: info["features"]["action"].update(names=["a", "b"]))
    with pytest.raises(DataError, match=r"got feature action as float32 \[2\] named .*expected"):
        merge([images, broken], out)
    assert not out.exists()


def test_a_damaged_source_leaves_nothing_half_written(images: Path, broken: Path, tmp_path: Path) -> None:
    edit_column(broken, ROWS, CAMERA, lambda cells: cells[6].update(bytes=b"nothing"))
    with pytest.raises(DataError, match=r"the data set made from it is not sound .*cannot be decoded"):
        merge([images, broken], tmp_path / "all")
    keep_rows(broken, ROWS, 9)
    with pytest.raises(DataError, match="run `playslot dataset repair` on it first"):
        merge([images, broken], tmp_path / "all")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken"]


def test_a_full_disk_while_merging_leaves_nothing(
    images: Path, broken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(merging, "require_verified", full)
    with pytest.raises(OutputError, match="the disk is full"):
        merge([images, broken], tmp_path / "all")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken"]


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["images", "video"])
def test_a_split_is_disjoint_and_complete(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    source: Path = request.getfixturevalue(kind)
    result = split(source, tmp_path / "parts", {"train": 0.6, "val": 0.4}, seed=3)
    assert sorted(i for indices in result.episodes.values() for i in indices) == [0, 1, 2]
    whole, frames, starts = content_fingerprint(source).episodes, frames_of(source), (0, 5, 8, 15)
    for name, indices in result.episodes.items():
        part = tmp_path / "parts" / name
        assert content_fingerprint(part).episodes == tuple(whole[i] for i in indices)
        expected = np.concatenate([frames[starts[i] : starts[i + 1]] for i in indices])
        assert np.array_equal(frames_of(part), expected)


@pytest.mark.integration
def test_a_video_without_key_frames_is_copied_whole(video: Path, tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import split_dataset

    split_dataset(load(video), {"some": [0, 2]}, output_dir=tmp_path / "theirs")  # one stream for both episodes
    source = tmp_path / "theirs" / "some"
    result = split(source, tmp_path / "parts", {"a": 0.5, "b": 0.5})
    whole = content_fingerprint(source).episodes
    for name, (index,) in result.episodes.items():
        assert content_fingerprint(tmp_path / "parts" / name).episodes == (whole[index],)


@pytest.mark.integration
def test_without_shares_there_is_a_part_for_each_task(images: Path, other: Path, tmp_path: Path) -> None:
    both = merge([images, other], tmp_path / "both").out
    result = split(both, tmp_path / "parts")
    whole = content_fingerprint(both).episodes
    assert sorted(i for indices in result.episodes.values() for i in indices) == list(range(len(whole)))
    tasks = [tuple(info(tmp_path / "parts" / name).tasks) for name in result.episodes]
    assert sorted(tasks) == sorted((words,) for words in info(both).tasks)
    for name, indices in result.episodes.items():
        assert content_fingerprint(tmp_path / "parts" / name).episodes == tuple(whole[i] for i in indices)


def test_parts_of_tasks_have_plain_names_and_an_episode_has_one_task() -> None:
    root = Path("set")
    tasks = [("Open the drawer!",), ("close it",), ("open the drawer",), ("close it",), ("\u62bd\u5c49",)]
    parts = by_task(tasks, root)
    assert parts == {"open-the-drawer_0": [0], "close-it": [1, 3], "open-the-drawer_2": [2], "task": [4]}
    with pytest.raises(DataError, match="got episode 1 of the tasks 'a', 'b', expected one"):
        by_task([("a",), ("a", "b")], root)


def test_the_draw_depends_on_the_seed_alone_and_adds_up() -> None:
    assert draw(10, {"a": 0.75, "b": 0.25}, 1) == draw(10, {"a": 0.75, "b": 0.25}, 1)
    assert draw(100, {"a": 0.5, "b": 0.5}, 1) != draw(100, {"a": 0.5, "b": 0.5}, 2)
    for episodes in range(3, 40):
        parts = draw(episodes, {"a": 1 / 3, "b": 1 / 3, "c": 1 / 3}, 0)
        assert sorted(i for part in parts.values() for i in part) == list(range(episodes))
        assert max(map(len, parts.values())) - min(map(len, parts.values())) <= 1


@pytest.mark.parametrize(
    ("fractions", "message"),
    [
        ({"train": 0.9, "val": 0.2}, r"got a sum of 1\.1, expected 1"),
        ({"train": 1.2, "val": -0.2}, "expected a plain name and a share"),
        ({"../train": 1.0}, "expected a plain name"),
        ({"train": 0.99, "val": 0.01}, "got 0.01 of 3 episodes for val, expected at least one"),
    ],
)
def test_shares_that_make_no_sense_are_refused(
    fractions: dict[str, float], message: str, images: Path, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=message):
        split(images, tmp_path / "parts", fractions)
    assert not list(tmp_path.iterdir())


@pytest.mark.integration
def test_a_merge_killed_before_it_gets_its_name_leaves_the_sources_and_the_same_command_does_it(
    images: Path, tmp_path: Path
) -> None:
    parts = [shutil.copytree(images, tmp_path / name) for name in ("a", "b")]
    before = [content_fingerprint(part).value for part in parts]
    out = tmp_path / "all"

    def write(tick: Callable[[], None]) -> None:
        def stop(*_: Any) -> None:
            tick()
            time.sleep(600)

        merging.require_verified = stop  # everything is written, nothing is named yet
        merge(parts, out)

    killed_while(write, 1)
    assert any(tmp_path.glob(".all.tmp-*/**/*.parquet"))
    assert not out.exists()
    assert [content_fingerprint(part).value for part in parts] == before
    result = merge(parts, out)
    assert (result.verification.ok, result.verification.episodes, result.verification.frames) == (True, 6, 30)
    assert content_fingerprint(out).episodes == content_fingerprint(images).episodes * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "all", "b"]


@pytest.mark.parametrize("stored", ["images", "video"])
def test_an_episode_without_actions_is_known_in_every_set_it_is_copied_to(
    stored: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    root: Path = request.getfixturevalue(stored)
    split(root, tmp_path / "parts", {"a": 0.4, "b": 0.6})
    parts = [tmp_path / "parts" / name for name in "ba"]
    merge(parts, tmp_path / "merged")

    def origins(at: Path, actions: float | None = None) -> list[str]:
        files = open_files(at)
        said = None if actions is None else np.full((files.rows, 2), actions, np.float32)
        found = episode_origins(files, said, tmp_path / "cache")
        assert found is not None
        return found.tolist()

    known = origins(root)
    assert len({*known}) == 3
    assert origins(tmp_path / "merged") == [one for part in parts for one in origins(part)]
    assert {*origins(tmp_path / "merged")} == {*known}
    assert origins(root, np.nan) == origins(root, 0.5) == known
