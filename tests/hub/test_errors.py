"""Errors of the Hub in one line: what was got, what was expected, what to do."""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import PLAIN_TOKEN, READ_TOKEN, FakeHub, Fault, Repository
from small_data import contents

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them

Client = Callable[..., dict[str, Any]]


def failed(answer: dict[str, Any], kind: str = "HubError") -> str:
    """The message of a failure, after a check of its form."""
    message: str = answer["error"]
    assert answer["type"] == kind, answer["traceback"]
    assert "\n" not in message
    assert "got" in message or kind == "OutputError"
    assert "expected" in message
    return message


def push(client: Client, root: Path, repo_id: str = "owner/press", **arguments: Any) -> dict[str, Any]:
    return client("push", root=root, repo_id=repo_id, **({"private": False} | arguments))


def test_pushing_without_a_token_says_how_to_log_in(hub: FakeHub, stranger: Client, data: Path) -> None:
    message = failed(push(stranger, data))
    assert "no token" in message
    assert "hf auth login" in message
    assert not hub.requests


def test_public_data_are_pulled_without_a_token(pushed: Repository, stranger: Client, tmp_path: Path) -> None:
    assert "error" not in stranger("pull", repo_id="owner/press", root=tmp_path / "there")


@pytest.mark.parametrize("call", ["push", "pull"])
def test_a_bad_token_is_told_from_a_missing_repository(
    pushed: Repository, client: Client, data: Path, tmp_path: Path, call: str
) -> None:
    arguments = {"push": {"root": data, "private": False}, "pull": {"root": tmp_path / "there"}}[call]
    answer = client(call, repo_id="owner/press", token="hf_MARKERnobodyknows0123456789", **arguments)
    assert "bad token" in failed(answer)


def test_a_token_that_would_be_shown_by_the_libraries_complaint_is_never_sent(
    hub: FakeHub, client: Client, data: Path
) -> None:
    message = failed(push(client, data, token="hf_MARKER0123\nhf_MARKER4567"))
    assert "a space or a line break" in message
    assert not hub.requests


def test_a_token_with_a_line_break_at_its_end_is_fine(hub: FakeHub, client: Client, data: Path) -> None:
    assert "error" not in push(client, data, token=f"{PLAIN_TOKEN}\n")


def test_a_token_that_may_only_read_cannot_push(hub: FakeHub, client: Client, data: Path) -> None:
    assert "403" in failed(push(client, data, token=READ_TOKEN))


def test_a_private_repository_is_hidden_from_strangers_and_others(
    hub: FakeHub, client: Client, stranger: Client, data: Path, tmp_path: Path
) -> None:
    push(client, data, "owner/hidden", private=True)
    message = failed(stranger("pull", repo_id="owner/hidden", root=tmp_path / "there"))
    assert "hidden from you: no token was sent" in message
    answer = client("pull", repo_id="owner/hidden", root=tmp_path / "there", token=READ_TOKEN)
    assert "hidden from your token" in failed(answer)
    assert "error" not in client("pull", repo_id="owner/hidden", root=tmp_path / "there")


def test_a_missing_repository_and_a_missing_revision_are_told_apart(
    pushed: Repository, client: Client, tmp_path: Path
) -> None:
    assert "no such data set" in failed(client("pull", repo_id="owner/none", root=tmp_path / "there"))
    answer = client("pull", repo_id="owner/press", root=tmp_path / "there", revision="v9")
    assert "no revision 'v9'" in failed(answer)


@pytest.mark.parametrize("name", ["press", "a/b/c", "owner/a b", "https://x.example/owner/press", ""])
def test_a_bad_name_is_refused(hub: FakeHub, client: Client, tmp_path: Path, name: str) -> None:
    assert "expected user/name" in failed(client("pull", repo_id=name, root=tmp_path / "there"))
    assert not hub.requests


PUSH_REQUESTS = [
    ("GET", "/whoami"), ("POST", "/repos/create"), ("GET", "/refs"), ("GET", "/revision/"), ("GET", "/tree/"),
    ("POST", "/validate-yaml"), ("POST", "/preupload/"), ("POST", "/objects/batch"), ("PUT", "/large/"),
    ("POST", "/verify"), ("POST", "/commit/"), ("POST", "/tag/"),
]  # fmt: skip


def test_an_error_of_the_hub_that_passes_is_not_seen(hub: FakeHub, client: Client, data: Path) -> None:
    hub.faults += [Fault(method, pattern, status=503) for method, pattern in PUSH_REQUESTS]
    answer = push(client, data)
    assert "error" not in answer, answer
    assert not any(fault.times for fault in hub.faults), "every one of them was met"
    files = hub.repositories["owner/press"].files()
    assert files.items() >= contents(data).items()
    assert len(hub.repositories["owner/press"].history) == 2


@pytest.mark.parametrize(("method", "pattern"), [PUSH_REQUESTS[0], PUSH_REQUESTS[6], PUSH_REQUESTS[8]])
def test_an_error_of_the_hub_that_stays_ends_the_push_and_the_same_command_carries_on(
    hub: FakeHub, client: Client, data: Path, method: str, pattern: str
) -> None:
    hub.faults.append(Fault(method, pattern, status=500, times=-1))
    answer = push(client, data)
    assert "got 500" in failed(answer)
    assert answer["slept"], "it was tried again"
    assert all(not repository.tags for repository in hub.repositories.values())
    assert all(len(repository.history) == 1 for repository in hub.repositories.values())
    hub.faults.clear()
    assert "error" not in push(client, data)


def test_large_files_that_arrived_before_a_failure_are_not_sent_again(hub: FakeHub, client: Client, data: Path) -> None:
    hub.faults.append(Fault("POST", "/commit/", status=500, times=-1))
    failed(push(client, data))
    assert hub.asked("PUT", "/large/")
    hub.faults.clear()
    hub.requests.clear()
    assert "error" not in push(client, data)
    assert not hub.asked("PUT", "/large/")


def test_a_push_that_died_before_the_tag_sets_it_the_next_time(hub: FakeHub, client: Client, data: Path) -> None:
    hub.faults.append(Fault("POST", "/tag/", status=500, times=-1))
    failed(push(client, data))
    hub.faults.clear()
    push(client, data)
    repository = hub.repositories["owner/press"]
    assert repository.tags == {"v3.0": repository.branches["main"]}
    assert len(repository.history) == 2


def test_an_error_of_the_hub_that_passes_is_not_seen_by_a_pull(
    pushed: Repository, hub: FakeHub, client: Client, data: Path, tmp_path: Path
) -> None:
    requests = [("GET", "/refs"), ("GET", "/revision/"), ("GET", "/tree/"), ("HEAD", "info.json"),
                ("GET", "stats.json"), ("HEAD", "file-001.parquet")]  # fmt: skip
    hub.faults += [Fault(method, pattern, status=502) for method, pattern in requests]
    answer = client("pull", repo_id="owner/press", root=tmp_path / "there")
    assert "error" not in answer, answer
    assert not any(fault.times for fault in hub.faults)
    assert contents(tmp_path / "there").items() >= contents(data).items()


def test_too_many_requests_are_explained(pushed: Repository, hub: FakeHub, client: Client, tmp_path: Path) -> None:
    hub.faults.append(Fault("GET", "/revision/", status=429, times=-1))
    assert "too many requests" in failed(client("pull", repo_id="owner/press", root=tmp_path / "there"))


def test_a_full_disk_is_told_before_and_during_the_transfer(
    pushed: Repository, client: Client, hub: FakeHub, tmp_path: Path
) -> None:
    def pull(**patches: Any) -> dict[str, Any]:
        return client("pull", repo_id="owner/press", root=tmp_path / "there", patches=patches)

    hub.requests.clear()
    assert "free disk" in failed(pull(free=1 << 20), "OutputError")
    assert not hub.asked("GET", r"/resolve/.*parquet")
    assert "disk is full" in failed(pull(full_disk=True), "OutputError")
    assert not (tmp_path / "there").exists()
    assert "error" not in pull()


def test_a_second_pull_into_the_same_folder_is_refused(pushed: Repository, client: Client, tmp_path: Path) -> None:
    with (tmp_path / ".there.pull.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "another pull" in failed(client("pull", repo_id="owner/press", root=tmp_path / "there"), "OutputError")
    assert "error" not in client("pull", repo_id="owner/press", root=tmp_path / "there")


def test_offline_mode_is_named(hub: FakeHub, start: Callable[..., Client], data: Path, tmp_path: Path) -> None:
    client = start(HF_HUB_OFFLINE="1")
    for answer in (push(client, data), client("pull", repo_id="owner/press", root=tmp_path / "there")):
        assert "HF_HUB_OFFLINE" in failed(answer)
    assert not hub.requests


def test_no_network_is_named_and_an_address_with_a_password_is_not_shown(
    start: Callable[..., Client], data: Path, tmp_path: Path
) -> None:
    client = start("http://me:MARKERpassword@127.0.0.1:9")
    for answer in (push(client, data), client("pull", repo_id="owner/press", root=tmp_path / "there")):
        assert "no connection to http://<token>@127.0.0.1:9" in failed(answer)
