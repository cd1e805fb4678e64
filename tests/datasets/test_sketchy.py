"""Sketchy in its published layout becomes LeRobot data sets with the paper's split, or one clear line and nothing."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from sketchy_layout import CAMERAS, LENGTHS, colour_of, example, frame_record, name_of, timestep, write_sketchy

from playslot_rl.data.source import open_sources
from playslot_rl.datasets.sketchy import convert_sketchy, split_episodes
from playslot_rl.errors import ConfigError, DataError, OutputError

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sketchy(tmp_path_factory.mktemp("published"))


@pytest.fixture(scope="module")
def converted(published: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("converted") / "sketchy"
    assert convert_sketchy(published, out) == {"train": 4, "eval": 1}
    return out


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A copy to break."""
    return write_sketchy(tmp_path / "source")


def refused(source: Path, message: str, **options: object) -> None:
    out = source.parent / "out"
    with pytest.raises(DataError, match=message) as caught:
        convert_sketchy(source, out, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in source.parent.iterdir()) == [source.name], "something half-written is left"


def test_the_split_is_the_papers_and_keeps_its_proportion() -> None:
    assert split_episodes(394) == (316, 78)
    assert split_episodes(197) == (158, 39)
    assert split_episodes(2) == (1, 1)
    assert split_episodes(1) == (1, 0)


def test_demonstrations_become_episodes_in_the_order_of_their_files(converted: Path, tmp_path: Path) -> None:
    train = open_sources(converted / "train", "observation.images.front_left", tmp_path)
    held_out = open_sources(converted / "eval", "observation.images.front_left", tmp_path)
    assert (*train.lengths, *held_out.lengths) == LENGTHS, "the agent's episode is no demonstration"
    assert (train.fps, train.image_size, train.task) == (10.0, (64, 64), "lift_green")
    for episode in range(4):
        for step in range(LENGTHS[episode]):
            mean = train.frames[train.starts[episode] + step].reshape(-1, 3).mean(0)
            np.testing.assert_allclose(mean, colour_of(episode, step, 0), atol=3)
    assert train.actions is not None
    np.testing.assert_allclose(train.actions[1], np.arange(7) + 1.5)


def test_plain_lerobot_opens_both_cameras(converted: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("any/name", root=converted / "train", video_backend="pyav")
    row = dataset[LENGTHS[0]]
    assert row["observation.images.front_right"].shape == (3, 64, 64)
    np.testing.assert_allclose(
        row["observation.images.front_right"].mean((1, 2)).numpy() * 255, colour_of(1, 0, 1), atol=3
    )
    np.testing.assert_allclose(row["observation.state"].numpy(), [*(np.arange(7) * 0.1), 0.25], atol=1e-6)
    assert row["task"] == "stack_green_on_red"


def test_the_record_says_where_each_episode_came_from(converted: Path) -> None:
    record = json.loads((converted / "train" / "meta" / "sketchy.json").read_text())
    assert [episode["file"] for episode in record["episodes"]] == [name_of(e) for e in range(4)]
    assert record["cameras"] == ["front_left", "front_right"]


def test_both_cameras_train_as_twice_the_episodes(converted: Path, tmp_path: Path) -> None:
    cameras = "observation.images.front_left, observation.images.front_right"
    both = open_sources([converted / "train"], cameras, tmp_path)
    assert both.episodes == 8
    last = both.frames[both.starts[4]].reshape(-1, 3).mean(0)
    np.testing.assert_allclose(last, colour_of(0, 0, 1), atol=3)


def test_cameras_size_and_number_can_be_chosen(published: Path, tmp_path: Path) -> None:
    made = convert_sketchy(published, tmp_path / "out", cameras=["back_left"], image_size=32, episodes=2)
    assert made == {"train": 1, "eval": 1}
    source = open_sources(tmp_path / "out" / "train", cache=tmp_path / "cache")
    assert (source.camera, source.image_size) == ("observation.images.back_left", (32, 32))


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    refused(tmp_path / "source", r"got no metadata\.sqlite")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("DROP TABLE EpisodeTags", "no such table: EpisodeTags"),
        ("ALTER TABLE Episodes RENAME COLUMN DataPath TO Path", "no such column"),
        ("DELETE FROM EpisodeTags WHERE Tag LIKE '%demos'", "got no episode tagged lift_green__demos or"),
    ],
)
def test_metadata_of_another_layout_are_refused(source: Path, script: str, message: str) -> None:
    database = sqlite3.connect(source / "metadata.sqlite")
    database.executescript(script)
    database.close()
    refused(source, message)


def test_a_metadata_file_that_is_no_database_is_refused(source: Path) -> None:
    (source / "metadata.sqlite").write_text("not found" * 100)
    refused(source, "file is not a database")


def test_a_missing_episode_names_the_cure(source: Path) -> None:
    (source / "episodes" / name_of(1)).unlink()
    refused(source, f"no file for 1 of 5 episodes, such as {name_of(1)}: download and extract")
    (source / "lift_green__demos-00000-of-00002.tar.bz2").write_bytes(b"")
    refused(source, r"extract the archives by Sketchy's extract\.sh")


def test_a_missing_camera_is_named_with_those_that_are_there(tmp_path: Path) -> None:
    source = write_sketchy(tmp_path / "source", cameras=CAMERAS[:1])
    refused(source, "step 0 has no picture pixels/basket_front_right.*these cameras: front_left")


def test_an_unknown_camera_is_a_wrong_argument(published: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data\.camera: got top, expected some of front_left, front_right"):
        convert_sketchy(published, tmp_path / "out", cameras=["top"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("episode", [0, 4])
def test_a_truncated_record_leaves_nothing(source: Path, episode: int) -> None:
    path = source / "episodes" / name_of(episode)
    path.write_bytes(path.read_bytes()[:-10])
    refused(source, f"{name_of(episode)}: record {LENGTHS[episode] - 1} is truncated")


def test_a_damaged_record_leaves_nothing(source: Path) -> None:
    path = source / "episodes" / name_of(2)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    refused(source, f"{name_of(2)}: record . has a wrong checksum")


def blank(width: int, height: int) -> bytes:
    """A picture of one colour whose pixels take hundreds of times what its file does."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.new("1", (width, height)).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros(6)}, "step 1 has 6 values under actions, expected 7"),
        ({"actions": b"x"}, "under actions, expected 7 numbers"),
        ({"pixels/basket_front_left": b"no picture"}, "step 1: pixels/basket_front_left cannot be decoded"),
        ({"pixels/basket_front_left": blank(9000, 9000)}, "cannot be decoded, expected a JPEG"),
    ],
)
def test_timesteps_of_another_layout_are_refused(source: Path, change: dict[str, object], message: str) -> None:
    steps = [timestep(0, 0), {**timestep(0, 1), **change}]
    (source / "episodes" / name_of(0)).write_bytes(b"".join(frame_record(example(step)) for step in steps))
    refused(source, message)


def test_an_empty_episode_is_refused(source: Path) -> None:
    (source / "episodes" / name_of(3)).write_bytes(b"")
    refused(source, "got an empty file")


def test_an_output_folder_with_something_in_it_is_left_alone(published: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="choose another out="):
        convert_sketchy(published, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_the_download_is_not_touched(published: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in published.rglob("*")}
    convert_sketchy(published, tmp_path / "out", cameras=["front_left"], episodes=1)
    assert {path: path.stat().st_mtime_ns for path in published.rglob("*")} == before
