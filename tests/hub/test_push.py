"""Pushing: what the Hub holds afterwards, and what never gets there."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from fake_hub import FakeHub, Fault, Repository
from small_data import contents, write_small

pytestmark = pytest.mark.integration

Client = Callable[..., dict[str, Any]]


def push(client: Client, root: Path, repo_id: str = "owner/press", **arguments: Any) -> dict[str, Any]:
    return client("push", root=root, repo_id=repo_id, **({"private": False} | arguments))


def test_a_push_puts_every_file_on_main_in_one_commit_and_tags_it(hub: FakeHub, client: Client, data: Path) -> None:
    before = contents(data)
    answer = push(client, data)
    repository = hub.repositories["owner/press"]
    files = repository.files()
    assert {path: files[path] for path in before} == before
    assert set(files) - set(before) == {".gitattributes", "README.md", "meta/playslot_hub.json"}
    assert len(repository.history) == 2  # the empty one, and ours
    assert repository.tags == {"v3.0": repository.branches["main"]}
    assert f"commit: {repository.branches['main']}" in answer["lines"]
    assert answer["result"]["commit"] == repository.branches["main"]
    assert contents(data) == before, "a push must not write into the data set"


def test_the_same_push_again_changes_nothing(pushed: Repository, client: Client, data: Path) -> None:
    history = list(pushed.history)
    answer = push(client, data)
    assert pushed.history == history
    assert answer["result"]["changed"] is False
    assert answer["lines"][0].startswith("nothing to push")


def test_a_push_with_fewer_files_removes_the_old_ones_in_the_same_commit(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    assert "data/chunk-000/file-001.parquet" in pushed.files()
    fewer = write_small(tmp_path / "fewer", lengths=(4,), shards=1, seed=1)
    answer = push(client, fewer)
    files = pushed.files()
    assert "data/chunk-000/file-001.parquet" not in files
    assert {path: files[path] for path in contents(fewer)} == contents(fewer)
    assert len(pushed.history) == 3
    assert answer["result"]["stale"] == ["data/chunk-000/file-001.parquet"]
    assert "deleted on the Hub: data/chunk-000/file-001.parquet" in answer["lines"]
    assert pushed.tags["v3.0"] == pushed.branches["main"], "LeRobot loads what the tag names"


def test_stale_files_that_something_else_left_are_deleted_and_other_files_are_not(
    pushed: Repository, client: Client, data: Path
) -> None:
    left = {"data/chunk-000/file-009.parquet": b"old", "videos/cam/chunk-000/file-000.mp4": b"old", "paper.pdf": b"x"}
    pushed.commit("main", pushed.files() | left)
    push(client, data)
    assert set(left) & set(pushed.files()) == {"paper.pdf"}


def test_a_push_to_a_branch_leaves_main_and_its_tag(pushed: Repository, client: Client, tmp_path: Path) -> None:
    main, tags = pushed.branches["main"], dict(pushed.tags)
    other = write_small(tmp_path / "other", lengths=(4, 4), seed=2)
    answer = push(client, other, branch="try/one")
    assert pushed.branches["main"] == main
    assert pushed.tags == tags
    assert pushed.files("try/one")["meta/info.json"] == (other / "meta/info.json").read_bytes()
    assert any("revision=try/one" in line for line in answer["lines"])


def test_a_tag_is_set_once_and_never_moves(pushed: Repository, client: Client, data: Path, tmp_path: Path) -> None:
    push(client, data, tag="paper")
    assert pushed.tags["paper"] == pushed.branches["main"]
    answer = push(client, write_small(tmp_path / "other", seed=5), tag="paper")
    assert "tag=paper" in answer["error"]
    assert pushed.tags["paper"] == pushed.branches["main"], "refused before anything was sent"


@pytest.mark.parametrize("name", [{"tag": "v4.0"}, {"branch": "v3.0"}])
def test_names_that_lerobot_takes_for_a_format_version_are_refused(
    hub: FakeHub, client: Client, data: Path, name: dict[str, str]
) -> None:
    assert "format version" in push(client, data, **name)["error"]
    assert not hub.repositories


def test_private_reaches_the_hub_and_a_public_repository_is_refused(hub: FakeHub, client: Client, data: Path) -> None:
    push(client, data, private=True)
    assert hub.repositories["owner/press"].private
    assert "(private)" in " ".join(push(client, data, private=False)["lines"]), "what is private stays private"
    hub.make("owner/open")
    answer = push(client, data, "owner/open", private=True)
    assert "got a public data set, expected a private one" in answer["error"]
    assert len(hub.repositories["owner/open"].history) == 1


def test_caches_journals_locks_and_the_note_of_a_pull_stay_here(hub: FakeHub, client: Client, data: Path) -> None:
    wanted = set(contents(data))
    for path in (".cache/huggingface/x.json", "frames/cache.npy", "data/.file.lock", "data.journal/0.npz",
                 "images/0.png", "meta/info.json.tmp", "meta/playslot_pull.json", "data/1.parquet.tmp"):  # fmt: skip
        (data / path).parent.mkdir(parents=True, exist_ok=True)
        (data / path).write_text("{}")
    answer = push(client, data)
    files = hub.repositories["owner/press"].files()
    assert set(files) == wanted | {".gitattributes", "README.md", "meta/playslot_hub.json"}
    assert len(answer["result"]["left"]) == 7
    assert any(line.startswith("not uploaded: ") for line in answer["lines"])


def test_a_data_set_that_is_not_whole_is_not_sent(hub: FakeHub, client: Client, data: Path) -> None:
    file = data / "data/chunk-000/file-001.parquet"
    file.write_bytes(file.read_bytes()[:-8])
    answer = push(client, data)
    assert answer["type"] == "DataError"
    assert not hub.requests


def test_another_format_version_is_not_sent(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    answer = push(client, write_small(tmp_path / "old", version="v2.1"))
    assert "v2.1" in answer["error"]
    assert not hub.requests


def test_what_the_hub_lists_is_compared_with_what_was_sent(hub: FakeHub, client: Client, data: Path) -> None:
    """A Hub that loses a file: the commit is made, and the tag is not moved to it."""
    original = Repository.commit

    def lossy(self: Repository, branch: str, files: dict[str, bytes]) -> str:
        return original(self, branch, {path: file for path, file in files.items() if path != "meta/stats.json"})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Repository, "commit", lossy)
        answer = push(client, data)
    assert "meta/stats.json" in answer["error"]
    assert not hub.repositories["owner/press"].tags


def test_two_pushes_at_once_do_not_mix(hub: FakeHub, client: Client, data: Path) -> None:
    repository = hub.make("owner/press")
    original = FakeHub.fault

    def meanwhile(self: FakeHub, method: str, path: str) -> Fault | None:
        if "/commit/" in path and len(repository.history) == 1:
            repository.commit("main", {"README.md": b"someone else"})
        return original(self, method, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeHub, "fault", meanwhile)
        answer = push(client, data)
    assert "another push in between" in answer["error"]
    assert repository.files() == {"README.md": b"someone else"}


def test_the_card_says_what_the_data_are_and_how_they_were_made(pushed: Repository) -> None:
    card = pushed.files()["README.md"].decode()
    _, header, text = card.split("---\n", 2)
    values = yaml.safe_load(header)
    assert values["license"] == "apache-2.0"
    assert values["task_categories"] == ["robotics"]
    assert {"LeRobot", "button_press"} <= set(values["tags"])
    assert values["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    fingerprint = json.loads(pushed.files()["meta/playslot_hub.json"])["fingerprint"]
    rows = dict(re.findall(r"(?m)^\| (.+?) \| (.+) \|$", text))
    expected = {"task": "press \\| the “button”", "frames a second": "10", "control rate": "50 Hz", "episodes": "3",
                "frames": "15", "success": "66.7 % of the episodes", "fingerprint": f"`{fingerprint}`",
                "policy": "expert", "noise on the expert's actions": "0.2", "base seed": "7",
                "versions": "mujoco 3.3.0"}  # fmt: skip
    assert expected.items() <= rows.items()
    assert 'LeRobotDataset("owner/press")' in text


def test_the_card_of_foreign_data_claims_no_licence(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    push(client, write_small(tmp_path / "foreign", ours=False))
    card = hub.repositories["owner/press"].files()["README.md"].decode()
    assert yaml.safe_load(card.split("---\n")[1])["license"] == "unknown"
    assert "| success | 66.7 % of the episodes |" in card, "counted from the data"
    assert "playslot collect" not in card


def test_a_card_written_by_hand_is_kept(pushed: Repository, client: Client, data: Path, tmp_path: Path) -> None:
    mine = b"---\nlicense: mit\n---\nMy words.\n"
    pushed.commit("main", pushed.files() | {"README.md": mine})
    other = write_small(tmp_path / "other", seed=3)
    assert push(client, other)["result"]["card_kept"]
    assert pushed.files()["README.md"] == mine
    (data / "README.md").write_bytes(mine + b"Local.\n")
    push(client, data)
    assert pushed.files()["README.md"] == mine + b"Local.\n"


def test_a_generated_card_follows_the_data(pushed: Repository, client: Client, tmp_path: Path) -> None:
    push(client, write_small(tmp_path / "other", lengths=(4,), shards=1))
    assert "| episodes | 1 |" in pushed.files()["README.md"].decode()
