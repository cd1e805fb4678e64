"""A token never appears in a log, a report or an error.

Every answer of every client in these tests is searched for tokens too (see conftest.py).
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_hub import PLAIN_TOKEN, WRITE_TOKEN, FakeHub, Fault, Repository

from playslot_rl.errors import HubError
from playslot_rl.hub.secrets import MASK, Redactor, checked_token

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


def test_errors_are_cleaned_with_their_causes_contexts_and_notes() -> None:
    token = "plain-MARKER"

    def fail() -> None:
        try:
            try:
                raise ValueError(f"inner {token}", (token, b"bytes plain-MARKER"))
            except ValueError as inner:
                inner.add_note(f"note {token}")
                raise KeyError(token) from inner
        except KeyError:
            outer = RuntimeError(f"outer {token}")
            outer.detail = f"attribute {token}"  # type: ignore[attr-defined]
            raise outer  # noqa: B904

    with pytest.raises(RuntimeError) as raised:
        fail()
    Redactor(token).error(raised.value)
    text = "".join(traceback.format_exception(raised.value)) + repr(vars(raised.value))
    shown = [line for line in text.splitlines() if "MARKER" in line and "raise ValueError" not in line]
    assert shown == []
    assert text.count(MASK) >= 6


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
    assert "MARKER" not in Redactor("the.MARKER").text(text)


def test_ordinary_text_stays() -> None:
    text = "owner/press at https://hub.example/datasets/owner/press: hf_hub_download of hf auth login failed"
    assert Redactor("the.MARKER").text(text) == text


def test_log_records_are_cleaned_with_their_arguments(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), Redactor("the.MARKER").logs():
        logging.getLogger("some.library").debug("headers %s", {"a": "the.MARKER"})
    logging.getLogger("some.library").warning("after: %s", "untouched")
    assert "MARKER" not in caplog.text
    assert MASK in caplog.text
    assert caplog.records[-1].args == ("untouched",)


@pytest.mark.parametrize("token", ["with space MARKER", "line\nbreak", "quote'", "café"])
def test_tokens_of_odd_characters_are_refused_without_showing_them(token: str) -> None:
    with pytest.raises(HubError) as raised:
        checked_token(token)
    assert token not in str(raised.value)
    assert checked_token(" plain\n") == "plain"
    assert checked_token("  ") is None
