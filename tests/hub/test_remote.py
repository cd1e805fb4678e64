"""Frames read from the Hub while they are wanted, without a copy of the data set."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import FakeHub
from hub_contents import Fault

from playslot_rl.cli import main
from playslot_rl.data.source import open_sources

pytestmark = pytest.mark.integration

Client = Callable[..., dict[str, Any]]
SMALL = ["env=grid_shapes", "preset=smoke", "threads=1", "device=cpu", "logging.progress=false"]
ADDRESS = "hf://datasets/owner/shapes"


@pytest.fixture(scope="module", params=["image", "video"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A data set of each way of storing frames."""
    root = tmp_path_factory.mktemp(request.param) / "made"
    words = ["collect", *SMALL, "policy=random", "episodes=4", f"collect.storage={request.param}", f"out={root}"]
    assert main([*words, "workers=1"]) == 0
    return root, request.param


def put(hub: FakeHub, root: Path, **more: bytes) -> str:
    """A commit with the data set's files on main."""
    if "owner/shapes" not in hub.repositories:
        hub.make("owner/shapes", private=False)
    files = {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    return hub.repositories["owner/shapes"].commit("main", files | more)


def test_frames_are_those_of_the_folder(made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path) -> None:
    root, storage = made
    put(hub, root)
    here, there = open_sources(root, cache=tmp_path), client("stream", root=ADDRESS, cache=tmp_path)
    assert "error" not in there, there
    assert there["frames"] == hashlib.sha256(here.frames[:].tobytes()).hexdigest()
    assert tuple(there["shape"]) == here.frames.shape
    assert there["lengths"] == here.lengths.tolist()
    assert here.actions is not None
    assert there["actions"] == (here.actions.tolist() if storage == "video" else None)
    assert ("whose actions are therefore not read" in there["said"]) == (storage == "image")
    kept = [path for path in (tmp_path / "remote").rglob("*") if path.is_file() and ".cache" not in path.parts]
    assert {path.parts[-2] for path in kept if path.suffix in (".json", ".parquet", ".mp4")} <= {"meta", "chunk-000"}
    assert not [path for path in kept if {"data", "videos"} & set(path.parts)], "frames were copied"


def test_the_fingerprint_is_of_the_content(
    made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    root, _ = made
    first = put(hub, root)
    before = client("stream", root=ADDRESS, cache=tmp_path)
    put(hub, root, **{"README.md": b"a card"})
    assert client("stream", root=ADDRESS, cache=tmp_path)["fingerprint"] == before["fingerprint"]
    info = (root / "meta" / "info.json").read_bytes()
    put(hub, root, **{"meta/info.json": info + b" "})
    assert client("stream", root=ADDRESS, cache=tmp_path)["fingerprint"] != before["fingerprint"]
    assert client("stream", root=f"{ADDRESS}@{first}", cache=tmp_path)["fingerprint"] == before["fingerprint"]


def test_the_tag_that_lerobot_loads_is_read_where_there_is_one(
    made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    root, _ = made
    hub.make("owner/shapes", private=False)
    hub.repositories["owner/shapes"].tags["v3.0"] = put(hub, root)
    put(hub, root, **{"meta/info.json": b"{}"})
    assert "error" not in client("stream", root=ADDRESS, cache=tmp_path)
    assert "damaged" in client("stream", root=f"{ADDRESS}@main", cache=tmp_path)["error"]


def test_a_training_reads_from_the_hub(made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path) -> None:
    root, _ = made
    put(hub, root)
    words = ["train-slots", *SMALL, f"data.root={ADDRESS}", "data.stream=true", f"data.cache={tmp_path / 'cache'}"]
    assert client("command", words=[*words, "slots.steps=2", f"out={tmp_path / 'run'}"])["status"] == 0
    assert (tmp_path / "run" / "slots" / "checkpoint" / "meta.json").is_file()
    assert client("command", words=[*words, "slots.steps=2", f"out={tmp_path / 'run'}"])["status"] == 0
    words = ["train-dynamics", *words[1:], f"run={tmp_path / 'run'}", "dynamics.steps=2"]
    assert client("command", words=words)["status"] == 0
    assert (tmp_path / "run" / "dynamics" / "checkpoint" / "meta.json").is_file()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("hf://datasets/owner/nothing", "got no such data set on "),
        (f"{ADDRESS}@other", "got no revision 'other', expected a branch, a tag or a commit"),
        ("hf://owner/shapes", "got no data set's address, expected hf://datasets/USER/NAME"),
    ],
)
def test_what_is_not_there(
    address: str, message: str, made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    put(hub, made[0])
    answer = client("stream", root=address, cache=tmp_path)
    assert (answer["type"], message in answer["error"]) == ("DataError", True), answer
    assert "\n" not in answer["error"]


def test_an_error_of_the_hub_passes_or_is_one_line(
    made: tuple[Path, str], hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    put(hub, made[0])
    hub.faults.append(Fault("GET", "resolve/.*/(data|videos)/", status=503))
    assert "error" not in client("stream", root=ADDRESS, cache=tmp_path)
    hub.faults.append(Fault("GET", "resolve/.*/(data|videos)/", status=503, times=-1, echo=True))
    answer = client("stream", root=ADDRESS, cache=tmp_path)
    assert "got 503, an error of the Hub's own" in answer["error"], answer
    assert answer["type"] == "DataError"


def test_without_streaming_it_is_pulled_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train-slots", *SMALL, f"data.root={ADDRESS}", f"out={tmp_path / 'run'}"]
    assert main(words) == 1
    assert "expected a folder, or data.stream=true" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
