"""A token never appears in a log, a report or an error.

Every answer of every client in these tests is searched for tokens too (see conftest.py).
"""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import PLAIN_TOKEN, WRITE_TOKEN, FakeHub, Fault, Repository

from playslot_rl.errors import DataError, HubError
from playslot_rl.hub.session import open_repository
from playslot_rl.storage.secrets import MASK, checked_token, mask, masked_logs

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them

Client = Callable[..., dict[str, Any]]


@pytest.mark.parametrize(
    ("pattern", "status"), [("/whoami", 401), ("/whoami", 500), ("/commit/", 400), ("/commit/", 403)]
)
def test_a_hub_that_repeats_the_token_in_its_errors_does_not_get_it_printed(
    hub: FakeHub, client: Client, data: Path, pattern: str, status: int
) -> None:
    hub.faults.append(Fault("*", pattern, status=status, echo=True, times=-1))
    answer = client("push", root=data, repo_id="owner/press", private=False, token=PLAIN_TOKEN)
    assert any(PLAIN_TOKEN in headers.get("authorization", "") for _, headers, _ in hub.asked("GET", "/whoami"))
    assert "error" in answer
    assert any(MASK in text for text in answer["chain"]), "the error did hold it"


def test_logs_at_the_debug_level_are_written_and_hold_no_token(hub: FakeHub, client: Client, data: Path) -> None:
    answer = client("push", root=data, repo_id="owner/press", private=False)
    assert any("Request" in line and "/whoami" in line for line in answer["logs"])
    assert any("receive_response_headers" in line for line in answer["logs"])


def test_what_is_uploaded_and_noted_holds_no_token(pushed: Repository, client: Client, tmp_path: Path) -> None:
    client("pull", repo_id="owner/press", root=tmp_path / "there")
    noted = b"".join(path.read_bytes() for path in (tmp_path / "there").rglob("*") if path.is_file())
    assert b"MARKER" not in noted + b"".join(pushed.files().values())


def test_the_command_line_prints_no_token_even_with_a_traceback(hub: FakeHub, data: Path, tmp_path: Path) -> None:
    hub.faults.append(Fault("*", "/whoami", status=401, echo=True, times=-1))
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")}
    environment |= {"HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path), "HF_TOKEN": WRITE_TOKEN, "PLAYSLOT_DEBUG": "1",
                    "HF_DEBUG": "1"}  # fmt: skip
    command = [sys.executable, "-m", "playslot_rl", "dataset", "push", str(data), "owner/press"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "Traceback" in done.stderr
    assert "curl" in done.stderr, "the client's own debug output"
    assert "bad token" in done.stderr
    assert "MARKER" not in done.stdout + done.stderr


@pytest.fixture
def online(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process may open a conversation; it asks nothing."""
    monkeypatch.setattr("huggingface_hub.is_offline_mode", lambda: False)


def fail(token: str) -> None:
    """As the client may: the Hub's answer in texts, values, attributes, notes and causes."""
    try:
        raise ValueError(f"inner {token}", (token, token.encode()))
    except ValueError as inner:
        inner.add_note(f"note {token}")
        outer = RuntimeError(f"outer {token}")
        outer.detail = f"attribute {token}"  # type: ignore[attr-defined]
        raise outer from inner


@pytest.mark.usefixtures("online")
def test_an_error_goes_on_as_one_line_with_its_masked_traceback_and_nothing_else(tmp_path: Path) -> None:
    token = "plain-MARKER"
    with pytest.raises(HubError) as raised, open_repository("me/press", tmp_path, token=token, writing=True):
        fail(token)
    error = raised.value
    assert str(error).startswith("me/press: got RuntimeError: outer <token> (unexpected")
    assert (error.__cause__, error.__context__) == (None, None)
    (note,) = error.__notes__
    assert "MARKER" not in note
    assert note.count(MASK) >= 5
    assert "Traceback" in note


@pytest.mark.usefixtures("online")
def test_our_own_errors_keep_their_kind_and_lose_tokens(tmp_path: Path) -> None:
    with (
        pytest.raises(DataError) as raised,
        open_repository("me/press", tmp_path, token="plain-MARKER", writing=False),
    ):
        raise DataError("got plain-MARKER, expected none")
    assert str(raised.value) == "got <token>, expected none"


@pytest.mark.parametrize(
    "text",
    [
        "Bearer abc-MARKER",
        "hf_MARKERabcdefghijklmnop",
        "https://user:MARKER@hub.example/x",
        "x=the.MARKER",
    ],
)
def test_tokens_are_found_by_shape_header_address_and_value(text: str) -> None:
    assert "MARKER" not in mask(text, "the.MARKER")


def test_ordinary_text_stays() -> None:
    text = "owner/press at https://hub.example/datasets/owner/press: hf_hub_download of hf auth login failed"
    assert mask(text, "the.MARKER") == text


def test_log_records_are_cleaned_with_their_arguments(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), masked_logs("the.MARKER"):
        logging.getLogger("some.library").debug("headers %s", {"a": "the.MARKER"})
        try:
            raise ValueError("hf_MARKERabcdefghijklmnop")
        except ValueError:
            logging.getLogger("some.library").exception("failed")
    logging.getLogger("some.library").warning("after: %s", "untouched")
    assert "MARKER" not in caplog.text
    assert MASK in caplog.text
    assert "ValueError: <token>" in caplog.text
    assert caplog.records[-1].args == ("untouched",)


def test_what_the_clients_own_handler_prints_is_masked_and_the_records_are_left_alone() -> None:
    logger, stream, seen = logging.getLogger("huggingface_hub.x"), io.StringIO(), []
    handler = logging.StreamHandler(stream)
    logging.getLogger("huggingface_hub").addHandler(handler)
    logger.addFilter(lambda record: seen.append(record) or True)  # type: ignore[func-returns-value]
    try:
        with masked_logs("the.MARKER"):
            logger.warning("503 of %s", "https://me:secret.MARKER@hub.example/x")
        logger.warning("after %s", "the.MARKER")
    finally:
        logging.getLogger("huggingface_hub").removeHandler(handler)
        logger.filters.clear()
    assert stream.getvalue() == "503 of https://<token>@hub.example/x\nafter the.MARKER\n"
    assert [record.args for record in seen] == [("https://me:secret.MARKER@hub.example/x",), ("the.MARKER",)]


@pytest.mark.parametrize("token", ["with space MARKER", "line\nbreak", "quote'", "café"])
def test_tokens_of_odd_characters_are_refused_without_showing_them(token: str) -> None:
    with pytest.raises(HubError) as raised:
        checked_token(token)
    assert token not in str(raised.value)
    assert checked_token(" plain\n") == "plain"
    assert checked_token("  ") is None
