"""`playslot play` as a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playslot_rl.runtime.processes import free_port

OUTPUT = "output.txt"
"""In the folder that the process works in: a pipe that nobody reads would stop it."""


@contextmanager
def served(folder: Path, *arguments: str, **environment: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A process that works in a folder, and the address that it prints, once it answers; killed at the end if it is
    still there."""
    port = free_port()
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    with (folder / OUTPUT).open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "playslot_rl", "play", *arguments, f"port={port}", "device=cpu"],
            cwd=folder, env=inherited | environment, text=True, stdout=output, stderr=subprocess.PIPE,
        )  # fmt: skip
    try:
        yield _address(folder, process), process
    finally:
        process.kill()
        process.communicate()


def _address(folder: Path, process: subprocess.Popen[str]) -> str:
    for _ in range(240):
        found = re.search(r"http://\S+", (folder / OUTPUT).read_text())
        try:
            if found is not None:
                urllib.request.urlopen(found[0], timeout=5).close()
                return found[0]
        except OSError:
            pass
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.5)
    raise AssertionError("no answer for two minutes")
