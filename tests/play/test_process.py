"""`playslot play` as a process of its own: its address, a browser that is not there, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from playslot_rl.processes import free_port


def test_without_a_browser_the_address_is_said_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    port = free_port()
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    process = subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", "play", "run=pretrained", f"port={port}", "play.show=true", "device=cpu"],
        cwd=tmp_path, env={**environment, "BROWSER": str(tmp_path / "none"), "PYTHONUNBUFFERED": "1"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        assert f"http://127.0.0.1:{port}" in said
        for _ in range(300):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).close()
                break
            except OSError:
                assert process.poll() is None
                time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert "stopped" in out
    assert "Traceback" not in err, err
    assert process.returncode == 0
