"""Fixtures: a Hub on localhost, and processes that talk to it."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_hub import WRITE_TOKEN, FakeHub, Repository
from small_data import write_small


class Client:
    """A process with settings of its own; calls come back as dicts (see client.py)."""

    def __init__(self, url: str, home: Path, **environment: str) -> None:
        variables = {k: v for k, v in os.environ.items() if not k.startswith(("HF_", "HUGGING"))}
        variables |= {"HF_ENDPOINT": url, "HF_HOME": str(home), "HF_TOKEN": WRITE_TOKEN, "HF_HUB_DISABLE_XET": "1",
                      "HF_HUB_DISABLE_TELEMETRY": "1"} | environment  # fmt: skip
        variables = {k: v for k, v in variables.items() if v}
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("client.py"))], env=variables, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip

    def __call__(self, call: str, patches: dict[str, Any] | None = None, **arguments: Any) -> dict[str, Any]:
        arguments = {name: str(value) if isinstance(value, Path) else value for name, value in arguments.items()}
        request = {"call": call, "arguments": arguments, "patches": patches or {}}
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        assert "MARKER" not in json.dumps(answer), "a token was shown"
        return answer

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(20)


@pytest.fixture(scope="session")
def running_hub() -> Iterator[FakeHub]:
    with FakeHub().running() as hub:
        yield hub


@pytest.fixture
def hub(running_hub: FakeHub) -> Iterator[FakeHub]:
    """An empty Hub."""
    running_hub.repositories.clear()
    running_hub.large.clear()
    running_hub.requests.clear()
    running_hub.faults.clear()
    yield running_hub
    running_hub.faults.clear()


@pytest.fixture(scope="session")
def start(running_hub: FakeHub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Client]]:
    """Starts clients: `start(HF_TOKEN="")`."""
    clients: list[Client] = []

    def make(url: str = running_hub.url, **environment: str) -> Client:
        clients.append(Client(url, tmp_path_factory.mktemp("home"), **environment))
        return clients[-1]

    yield make
    for client in clients:
        client.close()


@pytest.fixture(scope="session")
def client(start: Callable[..., Client]) -> Client:
    """A client that may write."""
    return start()


@pytest.fixture(scope="session")
def stranger(start: Callable[..., Client]) -> Client:
    """A client without a token."""
    return start(HF_TOKEN="")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A local data set."""
    return write_small(tmp_path / "data")


@pytest.fixture(scope="session")
def first_push(
    running_hub: FakeHub, client: Client, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Repository, dict[str, bytes]]:
    """What a push of the data set of `data` leaves on the Hub; made once, it is the same each time."""
    root = write_small(tmp_path_factory.mktemp("first") / "data")
    answer = client("push", root=root, repo_id="owner/press", private=False)
    assert "error" not in answer, answer
    return copy.deepcopy(running_hub.repositories["owner/press"]), dict(running_hub.large)


@pytest.fixture
def pushed(first_push: tuple[Repository, dict[str, bytes]], hub: FakeHub) -> Repository:
    """The data set of `data` on the Hub, public."""
    repository, large = first_push
    hub.large.update(large)
    hub.repositories["owner/press"] = copy.deepcopy(repository)
    return hub.repositories["owner/press"]
