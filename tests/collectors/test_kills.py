"""Real kills while collecting: what was complete stays, the same command carries on, no seed is missing or double."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_sets import SMALL, assert_whole, small, spec_of

from playslot_rl.collectors.journal import Journal, journal_path

PROGRAM = """
import json, sys
from pathlib import Path
from playslot_rl.collectors import collect
from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.errors import PlaySlotError
if __name__ == "__main__":
    settings, episodes, workers, out = json.loads(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    try:
        collect(from_dict(ExperimentConfig, settings), "random", episodes, 3, out, seed=0, workers=workers)
    except PlaySlotError as error:
        sys.exit(f"one line: {error}")
"""


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes of a test; whatever happens, none of them and of their children outlives it."""
    processes: list[subprocess.Popen[bytes]] = []
    yield processes
    for process in processes:
        for pid in [process.pid, *session_of(process.pid)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.communicate()


def start(
    started: list[subprocess.Popen[bytes]], tmp_path: Path, out: Path, episodes: int, **collector: Any
) -> subprocess.Popen[bytes]:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    settings = json.dumps({**SMALL, "collector": collector})
    command = [sys.executable, str(program), settings, str(episodes), "2", str(out)]
    started.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True))
    return started[-1]


def stored(out: Path) -> int:
    return len(list(journal_path(out).glob("episode_*.npz")))


def wait_for(happened: Any, process: subprocess.Popen[bytes] | None = None, timeout: float = 400.0) -> None:
    deadline = time.monotonic() + timeout
    while not happened():
        assert process is None or process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.005)


def status_of(pid: int) -> tuple[str, int, int]:
    """State, parent and session of a process, as the kernel tells them."""
    state, parent, _, session = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[:4]
    return state, int(parent), int(session)


def alive(pid: int) -> bool:
    try:
        return status_of(pid)[0] != "Z"
    except OSError:
        return False


def session_of(pid: int) -> list[int]:
    """Processes of the session that `pid` leads, itself left out: orphans stay in it."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, _, session = status_of(int(path.name))
            if session == pid and state != "Z" and int(path.name) != pid:
                found.append(int(path.name))
    return found


def workers_of(pid: int) -> list[int]:
    """Collector processes of a parent: those that its fork server has started (not that server, not the tracker)."""
    found, session = [], session_of(pid)
    for child in session:
        with contextlib.suppress(OSError):
            forked = b"multiprocessing.forkserver" in Path(f"/proc/{child}/cmdline").read_bytes()
            if forked and status_of(child)[1] in session:
                found.append(child)
    return found


def assert_no_orphans(pid: int) -> None:
    wait_for(lambda: not session_of(pid), timeout=20.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_workers_killed_and_stopped_are_replaced(
    reference: list[Any], tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    out = tmp_path / "data"
    process = start(started, tmp_path, out, episodes=80, timeout_s=8)
    wait_for(lambda: stored(out) >= 3, process)
    wait_for(lambda: len(workers_of(process.pid)) == 2, process)
    killed, stopped = workers_of(process.pid)
    os.kill(killed, signal.SIGKILL)
    os.kill(stopped, signal.SIGSTOP)
    errors = process.communicate(timeout=800)[1].decode()
    assert process.returncode == 0, errors
    assert "ended with SIGKILL: another takes its place" in errors
    assert "gave no answer for 8 s: another takes its place" in errors
    assert not alive(killed)
    assert not alive(stopped)
    assert_no_orphans(process.pid)
    assert_whole(out, 80, reference)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_death_beyond_the_limit_ends_in_one_line_and_the_same_command_carries_on(
    reference: list[Any], tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    out = tmp_path / "data"
    process = start(started, tmp_path, out, episodes=150, restarts=0)
    wait_for(lambda: stored(out) >= 3, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    errors = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 1
    assert errors.startswith("one line: a worker ended with SIGKILL")
    assert "Traceback" not in errors
    assert_no_orphans(process.pid)
    kept = {p.name: p.stat().st_mtime_ns for p in journal_path(out).glob("episode_*.npz")}
    assert 3 <= len(kept) < 150

    process = start(started, tmp_path, out, episodes=150)
    wait_for(lambda: stored(out) > len(kept), process)
    now = {p.name: p.stat().st_mtime_ns for p in journal_path(out).glob("episode_*.npz")}
    assert kept.items() <= now.items()  # none was recorded again
    children = session_of(process.pid)
    process.kill()  # and now the parent
    process.wait()
    wait_for(lambda: not any(alive(child) for child in children), timeout=20.0)
    assert_no_orphans(process.pid)
    small(out, 150)
    assert_whole(out, 150, reference)


@pytest.mark.slow
def test_interrupt_leaves_a_journal_to_go_on_from(tmp_path: Path, started: list[subprocess.Popen[bytes]]) -> None:
    out = tmp_path / "data"
    process = start(started, tmp_path, out, episodes=400)
    wait_for(lambda: stored(out) >= 2, process)
    os.killpg(process.pid, signal.SIGINT)
    errors = process.communicate(timeout=60)[1].decode()
    assert process.returncode != 0
    assert errors.strip().endswith("KeyboardInterrupt")
    assert errors.count("Traceback") == 1, errors  # ours, which the command line catches; none from the workers
    assert len(Journal(journal_path(out), spec_of(400)).missing()) == 400 - stored(out)
