"""Pulling: bit for bit what was pushed, or nothing."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_hub import FakeHub, Fault, Repository
from small_data import contents, write_small

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them

Client = Callable[..., dict[str, Any]]
RECORDS = {"README.md", "meta/playslot_hub.json", "meta/playslot_pull.json"}


def pull(client: Client, root: Path, repo_id: str = "owner/press", **arguments: Any) -> dict[str, Any]:
    return client("pull", root=root, repo_id=repo_id, **arguments)


def left_over(root: Path) -> list[str]:
    """What lies beside a folder."""
    return [path.name for path in root.parent.iterdir() if path.name.startswith(f".{root.name}")]


def test_a_pull_gets_bit_for_bit_what_was_pushed(
    pushed: Repository, client: Client, data: Path, tmp_path: Path
) -> None:
    answer = pull(client, tmp_path / "there")
    got = contents(tmp_path / "there")
    assert {path: file for path, file in got.items() if path not in RECORDS} == contents(data)
    assert set(got) - set(contents(data)) == RECORDS
    assert left_over(tmp_path / "there") == []
    origin = json.loads(got["meta/playslot_pull.json"])
    assert origin["commit"] == pushed.branches["main"]
    assert origin["repo_id"] == "owner/press"
    assert f"commit: {pushed.branches['main']}" in answer["lines"]
    assert "the tag LeRobot loads" in answer["lines"][1]
    assert "(as pushed)" in answer["lines"][3]


def test_what_was_pulled_can_be_pushed_again_and_has_the_same_fingerprint(
    pushed: Repository, hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    first = pull(client, tmp_path / "there")
    again = client("push", root=tmp_path / "there", repo_id="owner/copy", private=False)
    assert again["result"]["record"]["fingerprint"] == first["result"]["fingerprint"]
    assert "meta/playslot_pull.json" not in hub.repositories["owner/copy"].files()


def test_the_version_tag_is_pulled_and_a_newer_main_is_mentioned(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    tagged = pushed.tags["v3.0"]
    newer = pushed.commit("main", pushed.files() | {"paper.pdf": b"x"})
    answer = pull(client, tmp_path / "there")
    assert answer["result"]["commit"] == tagged
    assert newer[:12] in answer["lines"][1]
    assert pull(client, tmp_path / "newer", revision="main")["result"]["commit"] == newer


def test_without_the_tag_main_is_pulled(pushed: Repository, client: Client, tmp_path: Path) -> None:
    pushed.tags.clear()
    answer = pull(client, tmp_path / "there")
    assert answer["result"]["revision"] == "main"
    assert "no tag v3.0" in answer["lines"][1]


@pytest.mark.parametrize("kind", ["branch", "commit"])
def test_a_branch_or_a_commit_can_be_asked_for(pushed: Repository, client: Client, tmp_path: Path, kind: str) -> None:
    other = write_small(tmp_path / "other", seed=4)
    client("push", root=other, repo_id="owner/press", private=False, branch="try/one")
    revision = "try/one" if kind == "branch" else pushed.branches["try/one"]
    pull(client, tmp_path / "there", revision=revision)
    assert contents(tmp_path / "there").items() >= contents(other).items()


def test_a_folder_that_holds_something_is_refused_and_left_alone(
    pushed: Repository, client: Client, hub: FakeHub, tmp_path: Path
) -> None:
    root = tmp_path / "there"
    root.mkdir()
    (root / "mine.txt").write_text("x")
    hub.requests.clear()
    answer = pull(client, root)
    assert answer["type"] == "OutputError"
    assert contents(root) == {"mine.txt": b"x"}
    assert not hub.requests
    (root / "mine.txt").unlink()
    pull(client, root)  # empty
    assert f"commit {pushed.branches['main'][:12]} of owner/press" in pull(client, root)["error"]


def test_a_connection_cut_in_mid_file_is_resumed_where_it_stopped(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    data = write_small(tmp_path / "data", wide=12 << 20)
    client("push", root=data, repo_id="owner/press", private=False)
    cut = 11 << 20
    hub.faults.append(Fault("GET", r"/resolve/.*file-001\.parquet", cut=cut))
    pull(client, tmp_path / "there")
    ranges = [headers.get("range") for _, headers, _ in hub.asked("GET", r"/resolve/.*file-001\.parquet")]
    assert ranges[0] is None
    begin = int(str(ranges[1]).removeprefix("bytes=").removesuffix("-"))
    assert 8 << 20 < begin <= cut, "what had arrived is not fetched again"
    name = "data/chunk-000/file-001.parquet"
    assert (tmp_path / "there" / name).read_bytes() == (data / name).read_bytes()


def test_an_interrupted_pull_leaves_no_folder_and_carries_on_with_what_is_missing(
    pushed: Repository, hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    root = tmp_path / "there"
    hub.faults.append(Fault("*", r"/resolve/.*file-001\.parquet", status=500, times=-1))
    answer = pull(client, root)
    assert "got 500" in answer["error"]
    assert not root.exists()
    assert left_over(root) != []
    hub.faults.clear()
    hub.requests.clear()
    assert "error" not in pull(client, root)
    fetched = [path.rpartition("/")[2] for path, _, _ in hub.asked("GET", "/resolve/")]
    assert "file-001.parquet" in fetched
    assert "info.json" not in fetched
    assert left_over(root) == []


def test_a_pull_that_was_interrupted_never_mixes_two_commits(
    pushed: Repository, hub: FakeHub, client: Client, data: Path, tmp_path: Path
) -> None:
    root = tmp_path / "there"
    hub.faults.append(Fault("*", r"/resolve/.*file-001\.parquet", status=500, times=-1))
    pull(client, root)
    hub.faults.clear()
    other = write_small(tmp_path / "other", seed=9)
    client("push", root=other, repo_id="owner/press", private=False)
    pull(client, root)
    assert contents(root).items() >= contents(other).items()
    assert left_over(root) == []


def test_a_hub_that_is_down_does_not_pass_off_half_a_data_set_as_whole(
    pushed: Repository, hub: FakeHub, client: Client, tmp_path: Path
) -> None:
    """huggingface_hub returns what lies in the folder where the Hub does not answer, with a warning only."""
    root = tmp_path / "there"
    hub.faults.append(Fault("*", r"/resolve/.*file-001\.parquet", status=500, times=-1))
    pull(client, root)
    hub.faults[:] = [Fault("*", r"/tree/|/revision/", status=503, times=-1)]
    answer = pull(client, root)
    assert "got 503" in answer["error"]
    assert not root.exists()


def test_damaged_files_are_found_by_their_hash_and_fetched_anew(
    pushed: Repository, hub: FakeHub, client: Client, data: Path, tmp_path: Path
) -> None:
    hub.faults.append(Fault("GET", r"/resolve/.*file-000\.parquet", corrupt=True))
    answer = pull(client, tmp_path / "there")
    assert "damaged" in answer["error"]
    assert not (tmp_path / "there").exists()
    assert "error" not in pull(client, tmp_path / "there")
    assert contents(tmp_path / "there").items() >= contents(data).items()


def test_stale_files_on_the_hub_are_found_by_their_rows(pushed: Repository, client: Client, tmp_path: Path) -> None:
    stale = {"data/chunk-000/file-002.parquet": pushed.files()["data/chunk-000/file-001.parquet"]}
    pushed.commit("main", pushed.files() | stale)
    answer = pull(client, tmp_path / "there", revision="main")
    assert "files disagree" in answer["error"]
    assert "earlier push" in answer["error"]
    assert not (tmp_path / "there").exists()
    assert left_over(tmp_path / "there") == []


def test_data_changed_on_the_hub_are_found_by_the_fingerprint(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    other = write_small(tmp_path / "other", seed=8)
    name = "data/chunk-000/file-000.parquet"
    pushed.commit("main", pushed.files() | {name: (other / name).read_bytes()})
    answer = pull(client, tmp_path / "there", revision="main")
    assert "fingerprint" in answer["error"]
    assert not (tmp_path / "there").exists()


def test_data_pushed_by_lerobot_are_pulled_and_the_missing_fingerprint_is_said(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    files = pushed.files()
    pushed.commit("main", {path: file for path, file in files.items() if path != "meta/playslot_hub.json"})
    answer = pull(client, tmp_path / "there", revision="main")
    assert "the Hub names none" in answer["lines"][3]


def test_a_value_that_is_nan_is_the_owner_s_and_no_fault_of_the_transfer(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    files = {path: file for path, file in pushed.files().items() if path != "meta/playslot_hub.json"}
    name, content = "data/chunk-000/file-000.parquet", io.BytesIO()
    table = pq.read_table(io.BytesIO(files[name]))
    actions = pa.array([[math.nan, 0.0], *table.column("action").to_pylist()[1:]], table.schema.field("action").type)
    pq.write_table(table.set_column(table.schema.get_field_index("action"), "action", actions), content)
    pushed.commit("main", files | {name: content.getvalue()})
    answer = pull(client, tmp_path / "there", revision="main")
    assert answer["lines"][5:] == [
        "warning: episode 0: got a value of action that is NaN or infinite, expected numbers"
    ]
    assert (tmp_path / "there" / name).read_bytes() == content.getvalue()


def test_another_format_version_is_refused_before_it_is_fetched(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    old = write_small(tmp_path / "old", version="v2.1")
    repository = hub.make("owner/old")
    repository.commit("main", contents(old))
    answer = pull(client, tmp_path / "there", "owner/old")
    assert "got LeRobot format v2.1, expected v3.0" in answer["error"]
    assert not hub.asked("GET", r"/resolve/.*parquet")
    assert left_over(tmp_path / "there") == []


def test_something_that_is_no_data_set_is_refused(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    hub.make("owner/empty")
    assert "got no meta/info.json" in pull(client, tmp_path / "there", "owner/empty")["error"]


def test_caches_on_the_hub_are_not_pulled(pushed: Repository, client: Client, tmp_path: Path) -> None:
    pushed.commit("main", pushed.files() | {"frames/cache.npy": b"x", "meta/.hidden.json": b"x", ".env": b"x"})
    pull(client, tmp_path / "there", revision="main")
    assert not any("cache" in path or "/." in path or path == ".env" for path in contents(tmp_path / "there"))
