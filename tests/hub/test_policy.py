"""Policies to the fake Hub and back: one commit, checked on both sides, tokens shown nowhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_hub import READ_TOKEN, FakeHub, Fault

from playslot_rl.sharing.card import MARK
from playslot_rl.sharing.folder import FILES, RANGE, SharedPolicyConfig, load_pretrained, save_pretrained
from playslot_rl.testing import tiny_agent

pytestmark = pytest.mark.slow  # a process of its own imports torch and huggingface_hub

Client = Callable[..., dict[str, Any]]
NAME = "models/owner/press"
HEADER = "---\nlicense: apache-2.0\n---\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small policy."""
    return write(tmp_path / "policy", seed=0)


def write(folder: Path, seed: int, high: float = 1.0) -> Path:
    agent = tiny_agent(seed=seed)
    agent.action_decoder.action_range.take(-torch.ones(4), torch.full((4,), high))
    config = SharedPolicyConfig(env=agent.world_model.env, model=agent.world_model.config)
    save_pretrained(agent, folder, config, lambda written: f"{HEADER}{MARK}\nweights {written.fingerprint}\n")
    return folder


def push(client: Client, folder: Path, **arguments: Any) -> dict[str, Any]:
    return client("push_policy", folder=folder, repo_id="owner/press", **{"private": False, **arguments})


def test_a_pushed_policy_is_whole_in_one_commit_and_comes_back(
    hub: FakeHub, client: Client, folder: Path, tmp_path: Path
) -> None:
    answer = push(client, folder, private=True, tag="first")
    assert "error" not in answer, answer
    there = hub.repositories[NAME]
    assert there.private
    assert {name: there.files()[name] for name in FILES} == {name: (folder / name).read_bytes() for name in FILES}
    assert len(there.history) == 2, "the empty repository, and one commit"
    assert there.tags == {"first": there.branches["main"]}
    assert answer["result"]["fingerprint"] == load_pretrained(folder)[1].fingerprint
    pulled = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")
    assert "error" not in pulled, pulled
    assert {path.name for path in Path(pulled["folder"]).iterdir()} == set(FILES)
    assert load_pretrained(Path(pulled["folder"]))[1] == load_pretrained(folder)[1]


def test_the_range_of_a_robots_actions_goes_along(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    folder = write(tmp_path / "arm", seed=0, high=90.0)
    assert "error" not in push(client, folder)
    assert RANGE in hub.repositories[NAME].files()
    pulled = Path(client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")["folder"])
    assert {path.name for path in pulled.iterdir()} == {*FILES, RANGE}
    assert load_pretrained(pulled)[1].actions["high"] == [90.0] * 4
    (folder / RANGE).unlink()
    assert f"{RANGE} is missing, expected a whole policy" in push(client, folder)["error"]


def test_the_same_push_again_changes_nothing_and_a_new_policy_replaces_the_old(
    hub: FakeHub, client: Client, folder: Path, tmp_path: Path
) -> None:
    push(client, folder)
    again = push(client, folder)
    assert not again["result"]["changed"]
    assert "nothing to push" in again["lines"][0]
    first = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")["folder"]
    other = write(tmp_path / "other", seed=1)
    assert push(client, other)["result"]["changed"]
    second = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")["folder"]
    assert first != second, "each commit has a folder of its own in the cache"
    assert load_pretrained(Path(second))[1] == load_pretrained(other)[1]
    old = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache", revision=Path(first).name)
    assert old["folder"] == first


def test_offline_a_branch_is_the_commit_that_was_last_pulled(
    hub: FakeHub, client: Client, start: Callable[..., Client], folder: Path, tmp_path: Path
) -> None:
    push(client, folder)
    asked = {"repo_id": "owner/press", "cache": tmp_path / "cache"}
    offline = start(HF_HUB_OFFLINE="1")
    assert "HF_HUB_OFFLINE" in offline("pull_policy", **asked)["error"]
    pulled = client("pull_policy", **asked)["folder"]
    push(client, write(tmp_path / "other", seed=1))
    assert offline("pull_policy", **asked)["folder"] == pulled
    assert offline("pull_policy", **asked, revision="main")["folder"] == pulled
    assert "HF_HUB_OFFLINE" in offline("pull_policy", **asked, revision="first")["error"]
    newer = client("pull_policy", **asked)["folder"]
    assert newer != pulled
    assert offline("pull_policy", **asked)["folder"] == newer


def test_a_card_written_by_hand_and_foreign_files_stay(hub: FakeHub, client: Client, folder: Path) -> None:
    push(client, folder)
    there = hub.repositories[NAME]
    there.commit("main", {**there.files(), "README.md": b"by hand", "video.mp4": b"press"})
    answer = push(client, folder)
    assert answer["result"]["card_kept"]
    assert there.files()["README.md"] == b"by hand"
    assert there.files()["video.mp4"] == b"press"
    (folder / "README.md").write_text(f"{HEADER}my own words")
    push(client, folder)
    assert there.files()["README.md"] == f"{HEADER}my own words".encode()


def test_a_tag_never_moves(hub: FakeHub, client: Client, folder: Path, tmp_path: Path) -> None:
    push(client, folder, tag="v1")
    commit = hub.repositories[NAME].tags["v1"]
    assert "error" not in push(client, folder, tag="v1")
    assert "tags are not moved" in push(client, write(tmp_path / "other", 1), tag="v1")["error"]
    assert hub.repositories[NAME].tags["v1"] == commit


def test_a_damaged_folder_is_not_sent(hub: FakeHub, client: Client, folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x7f")
    assert "got fingerprint" in push(client, folder)["error"]
    assert hub.requests == []


@pytest.mark.parametrize(
    ("fault", "arguments", "message"),
    [
        (None, {"token": READ_TOKEN}, "got 403"),
        (None, {"token": "hf_MARKERnobody0123456789"}, "got 401, a bad token"),
        (Fault("*", "/commit/", status=500, times=-1, echo=True), {}, "got 500"),
        (Fault("*", "/commit/", status=412), {}, "another push in between"),
    ],
)
def test_what_goes_wrong_is_said_in_one_line_and_leaves_main_as_it_was(
    hub: FakeHub, client: Client, folder: Path, fault: Fault | None, arguments: dict[str, Any], message: str
) -> None:
    hub.faults += [fault] if fault else []
    answer = push(client, folder, **arguments)
    assert message in answer["error"]
    assert "\n" not in answer["error"]
    assert NAME not in hub.repositories or list(hub.repositories[NAME].files()) == [".gitattributes"]


def test_a_pull_names_what_it_did_not_find(hub: FakeHub, client: Client, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    missing = client("pull_policy", repo_id="owner/none", cache=cache)["error"]
    assert "got no such model" in missing
    hub.make("models/owner/other")
    assert "got no config.json, expected a PlaySlot policy" in client(
        "pull_policy", repo_id="owner/other", cache=cache
    )["error"]  # fmt: skip
    assert "got no revision 'v9'" in client(
        "pull_policy", repo_id="owner/other", cache=cache, revision="v9"
    )["error"]  # fmt: skip
    assert "user/name" in client("pull_policy", repo_id="press", cache=cache)["error"]


def test_a_flipped_byte_on_the_way_is_found_and_the_next_pull_succeeds(
    hub: FakeHub, client: Client, folder: Path, tmp_path: Path
) -> None:
    push(client, folder)
    hub.faults.append(Fault("GET", "/resolve/.*safetensors", corrupt=True))
    answer = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")
    assert "damaged files" in answer["error"], answer
    assert not list((tmp_path / "cache").rglob("model.safetensors"))
    again = client("pull_policy", repo_id="owner/press", cache=tmp_path / "cache")
    assert load_pretrained(Path(again["folder"]))[1] == load_pretrained(folder)[1]
