"""Repositories and folders that mean no good: one line, nothing written elsewhere, nothing left, nothing sent."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import FakeHub, Repository
from hostile import METADATA, linked, nested

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them

Client = Callable[..., dict[str, Any]]

NAMES = [
    "meta/a\\..\\b.json",
    "meta\\..\\..\\b.json",
    "data/chunk-000/..\\..\\file-009.parquet",
    "meta/a\nb.json",
    "meta/" + "x" * 300 + ".json",
]
PULLED = ["fps NaN", "width of ten digits", "a camera with a slash", "lists in lists", "shape zero", "length huge"]


@pytest.mark.parametrize("name", NAMES)
def test_a_file_whose_name_leads_elsewhere_is_refused_before_anything_is_fetched(
    name: str, pushed: Repository, hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    pushed.tags["v3.0"] = pushed.commit("main", pushed.files() | {name: b"{}"})
    hub.requests.clear()
    answer = client("pull", root=tmp_path / "there", repo_id="owner/press")
    if "\\" in name.partition("/")[0]:  # of no folder of a data set: it is not fetched
        assert "error" not in answer
        shutil.rmtree(tmp_path / "there")
    else:
        assert "expected a path of plain names" in answer["error"]
        assert "unexpected" not in answer["error"]
        assert "\n" not in answer["error"]
        assert not hub.asked("GET", "/resolve/")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", PULLED)
def test_hostile_metadata_are_refused_by_a_pull_and_nothing_is_left(
    name: str, pushed: Repository, client: Client, data: Path, tmp_path: Path
) -> None:
    METADATA[name](data)
    files = {path.relative_to(data).as_posix(): path.read_bytes() for path in data.rglob("*") if path.is_file()}
    pushed.tags["v3.0"] = pushed.commit("main", files)
    answer = client("pull", root=tmp_path / "there", repo_id="owner/press")
    assert answer["type"] == "DataError"
    assert "unexpected" not in answer["error"]
    assert "\n" not in answer["error"]
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize("name", ["fps NaN", "width of ten digits", "a camera with a slash", "length huge"])
def test_hostile_metadata_are_refused_by_a_push_before_anything_is_sent(
    name: str, hub: FakeHub, client: Client, data: Path
) -> None:
    METADATA[name](data)
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert answer["type"] == "DataError"
    assert "unexpected" not in answer["error"]
    assert hub.requests == []


@pytest.mark.parametrize("name", ["data/chunk-000/file-000.parquet", "meta/stats.json"])
def test_a_link_out_of_the_set_is_refused_by_a_push(name: str, hub: FakeHub, client: Client, data: Path) -> None:
    linked(name)(data)
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert "got a link out of the data set" in answer["error"]
    assert hub.requests == []


def test_what_lies_beside_a_set_by_a_link_is_not_sent(hub: FakeHub, client: Client, data: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("MARK of a secret")
    for name in ("LICENSE", "README.md", "notes.txt"):
        (data / name).symlink_to(tmp_path / "secret")
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert "error" not in answer
    files = hub.repositories["owner/press"].files()
    assert not any(b"MARK of a secret" in content for content in files.values())
    assert "LICENSE" not in files


def test_a_hidden_file_is_not_sent(hub: FakeHub, client: Client, data: Path) -> None:
    (data / "data/chunk-000/._file-000.parquet").write_bytes(b"\x00\x05\x16\x07")
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert "error" not in answer
    assert not any("._" in path for path in hub.repositories["owner/press"].files())


def test_rows_nested_deeper_are_not_pushed_as_sound(hub: FakeHub, client: Client, data: Path) -> None:
    nested("data/chunk-000/more/file-001.parquet")(data)
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert "got a parquet file that no reader looks for" in answer["error"]
    assert hub.requests == []


def test_a_streamed_set_with_hostile_metadata_is_refused(
    pushed: Repository, client: Client, data: Path, tmp_path: Path
) -> None:
    info = json.loads((data / "meta/info.json").read_text())
    for change, message in (
        ({"data_path": "../{chunk_index}/{file_index}.parquet"}, "got data_path"),
        ({"fps": float("nan")}, "got fps nan"),
    ):
        content = json.dumps(info | change).encode()
        pushed.tags["v3.0"] = pushed.commit("main", pushed.files() | {"meta/info.json": content})
        answer = client("stream", root="hf://datasets/owner/press", cache=tmp_path / "cache")
        assert message in answer["error"]
