"""`playslot play` as a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playslot_rl.processes import free_port


@contextmanager
def served(folder: Path, *arguments: str, **environment: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A process that works in a folder, and its address once it answers; killed at the end if it is still there."""
    port = free_port()
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    process = subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", "play", *arguments, f"port={port}", "device=cpu"],
        cwd=folder, env=inherited | environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(240):
            try:
                urllib.request.urlopen(address, timeout=5).close()
                break
            except OSError:
                assert process.poll() is None, process.communicate()[1]
                time.sleep(0.5)
        yield address, process
    finally:
        process.kill()
        process.communicate()
