"""`playslot play` as a process of its own: its address, a browser that is not there, Ctrl-C."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from served import OUTPUT, served

pytestmark = pytest.mark.integration


def test_without_a_browser_the_address_is_said_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    no_browser = str(tmp_path / "none")
    with served(tmp_path, "run=pretrained", "play.show=true", BROWSER=no_browser) as (address, process):
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    out = (tmp_path / OUTPUT).read_text()
    assert address in out.splitlines()[0]
    assert "stopped" in out
    assert "Traceback" not in err, err
    token = address.partition("=")[2]
    assert len(token) >= 32
    assert token not in err
    assert out.count(token) == 1
    assert process.returncode == 0
