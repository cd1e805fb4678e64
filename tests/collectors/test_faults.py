"""Faults while collecting: what was complete stays, the same command carries on, no seed is missing or double."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from small_sets import assert_whole, begin, small, spec_of
from tiny_disk import tiny_disk

from playslot_rl.collectors import recording, workers
from playslot_rl.collectors.journal import Journal
from playslot_rl.collectors.recording import record_into
from playslot_rl.config import CollectorConfig
from playslot_rl.errors import ConfigError, OutputError, PlaySlotError

pytestmark = pytest.mark.integration

# --- handing out, with workers that are not processes ----------------------------------------------------------------


class Script:
    """What made-up workers do: each episode is stored at once, but for the faults that are left."""

    def __init__(self, dies: dict[int, int], hangs: dict[int, int]) -> None:
        self.dies, self.hangs = dies, hangs
        self.recorded: list[int] = []
        self.started: list[ScriptedWorker] = []


class ScriptedWorker:
    """A worker that is no process: it answers as soon as it is asked, or never, or with the error of a dead one."""

    def __init__(self, script: Script) -> None:
        self.script, self.alive, self.ready = script, True, Future[Any]()
        self.dead = self.stuck = False
        self.ready.set_result(None)
        script.started.append(self)

    def submit(self, asked: tuple[int]) -> Future[Any]:
        answer, (index,) = Future[Any](), asked
        if not (self.dead or self.stuck):
            self.dead, self.stuck = (bool(faults.get(index)) for faults in (self.script.dies, self.script.hangs))
            for faults in (self.script.dies, self.script.hangs):
                faults[index] = max(0, faults.get(index, 0) - 1)
        if self.dead:
            answer.set_exception(BrokenProcessPool())
        elif not self.stuck:
            self.script.recorded.append(index)
            answer.set_result(None)
        return answer

    def lost(self, error: Exception) -> str:
        assert isinstance(error, BrokenProcessPool)
        return "ended with SIGKILL"

    def close(self) -> None:
        self.alive = False


def run_scripted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: CollectorConfig, **faults: dict[int, int]
) -> tuple[list[int], Script, list[str]]:
    script = Script(faults.get("dies", {}), faults.get("hangs", {}))
    monkeypatch.setattr(workers, "LocalWorker", lambda make: ScriptedWorker(script))
    monkeypatch.setattr(workers, "POLL_S", 0.01)
    monkeypatch.setattr(recording, "check_rendering", lambda: None)
    said: list[str] = []
    journal = Journal(tmp_path / "journal", spec_of(9))
    try:
        found = list(record_into(journal, range(9), 3, settings, said.append))
    finally:
        assert not any(worker.alive for worker in script.started)
    return found, script, said


def test_each_episode_is_handed_out_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, script, said = run_scripted(tmp_path, monkeypatch, CollectorConfig())
    assert sorted(found) == sorted(script.recorded) == list(range(9))
    assert (len(script.started), said) == (3, [])


def test_dead_workers_are_replaced_and_their_episodes_recorded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, script, said = run_scripted(tmp_path, monkeypatch, CollectorConfig(restarts=3), dies={1: 2, 8: 1})
    assert sorted(found) == sorted(script.recorded) == list(range(9))
    assert len(script.started) == 3 + 3
    assert len(said) == 3
    assert "SIGKILL" in said[0]
    assert "episodes in hand: 1" in said[0]


def test_a_worker_that_hangs_is_killed_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = CollectorConfig(timeout_s=1e-4, restarts=2)
    found, script, said = run_scripted(tmp_path, monkeypatch, settings, hangs={4: 1})
    assert sorted(found) == list(range(9))
    assert len(script.started) == 3 + 1
    assert "gave no answer" in said[0]


def test_the_time_that_a_worker_takes_to_start_is_not_its_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    script, said = Script({}, {4: 1}), list[str]()
    monkeypatch.setattr(workers, "LocalWorker", lambda make: ScriptedWorker(script))
    monkeypatch.setattr(workers, "POLL_S", 0.02)
    settings = CollectorConfig(timeout_s=0.01)
    pool = workers.Workers(lambda: lambda index: None, 1, settings, lambda why, _: said.append(why))
    ready = script.started[0].ready = Future()
    pool.submit(0, 4)
    assert (list(pool.answers()), said) == ([], [])
    ready.set_result(None)
    assert (list(pool.answers()), said) == ([], [])
    assert list(pool.answers()) == []
    assert "gave no answer" in said[0]
    assert list(pool.answers()) == [((4,), None)]
    pool.close()


def test_too_many_dead_workers_end_the_collection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PlaySlotError, match=r"collector\.restarts=2.*the same command carries on"):
        run_scripted(tmp_path, monkeypatch, CollectorConfig(restarts=2), dies={0: 99})


def test_missing_ray_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.runtime import ray_cluster

    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"playslot_rl\[ray\]"):
        list(record_into(Journal(tmp_path / "j", spec_of(2)), range(2), 2, CollectorConfig(backend="ray")))


# --- two processes ---------------------------------------------------------------------------------------------------

HOLD = """
import fcntl, os, sys, time
handle = os.open(sys.argv[1], os.O_CREAT | os.O_RDWR)
fcntl.flock(handle, fcntl.LOCK_EX)
print("locked", flush=True)
time.sleep(600)
"""


def test_second_process_is_refused_and_a_dead_ones_lock_is_free(
    recorded: Path, reference: list[Any], tmp_path: Path
) -> None:
    out = tmp_path / "data"
    journal = begin(recorded, out)
    (journal.folder / ".episode_000001.npz.tmp-0123").write_bytes(b"half")
    with subprocess.Popen([sys.executable, "-c", HOLD, str(journal.folder / "lock")], stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == b"locked\n"
        began = time.monotonic()
        with pytest.raises(OutputError, match="got another process collecting into it"):
            small(out, 3)
        assert time.monotonic() - began < 5.0
        assert journal.missing() == []
        first.kill()
    small(out, 3)
    assert_whole(out, 3, reference)


@pytest.mark.parametrize(
    "left", [(), ("lock",), ("lock", "collection.json"), ("collection.json", "episode_000001.npz")]
)
def test_a_removal_of_the_journal_that_was_killed_is_ended(
    recorded: Path, tmp_path: Path, left: tuple[str, ...]
) -> None:
    out = tmp_path / "data"
    journal = begin(recorded, out)
    small(out, 3)
    shutil.copytree(recorded, journal.folder)
    (journal.folder / "lock").touch()
    for path in journal.folder.iterdir():
        if path.name not in left:
            path.unlink()
    small(out, 3)
    assert not journal.folder.exists()


def test_journal_removed_by_another_process_is_noticed(recorded: Path, tmp_path: Path) -> None:
    journal = begin(recorded, tmp_path / "data")
    original = fcntl.flock

    def lock_then_lose(handle: int, operation: int) -> None:
        original(handle, operation)
        shutil.rmtree(journal.folder)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fcntl, "flock", lock_then_lose)
        with pytest.raises(OutputError, match="just removed"), journal.lock():
            pass


# --- full disk -------------------------------------------------------------------------------------------------------


def test_disk_that_fills_while_recording_keeps_what_was_stored(
    recorded: Path, reference: list[Any], tmp_path: Path
) -> None:
    with tiny_disk(tmp_path / "disk", 96) as disk:
        journal = begin(recorded, disk / "data", without=2)
        before = [journal.path(i).read_bytes() for i in range(2)]
        free = shutil.disk_usage(disk).free
        (disk / "ballast").write_bytes(b"0" * (free - 4096))
        with pytest.raises(OutputError, match="disk is full"):
            small(disk / "data", 3)
        assert [journal.path(i).read_bytes() for i in range(2)] == before
        assert journal.missing() == [2]
        assert not (disk / "data").exists()
        (disk / "ballast").unlink()
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        small(disk / "data", 3)
        assert_whole(disk / "data", 3, reference)


def test_disk_that_fills_while_exporting_keeps_the_journal(
    recorded: Path, reference: list[Any], tmp_path: Path
) -> None:
    with tiny_disk(tmp_path / "disk", 128) as disk:
        journal = begin(recorded, disk / "data")
        free = shutil.disk_usage(disk).free
        (disk / "ballast").write_bytes(b"0" * (free - 16384))
        with pytest.raises(OutputError, match="disk is full"):
            small(disk / "data", 3)
        assert journal.missing() == []
        assert not (disk / "data").exists()
        assert not list(disk.glob(".data.tmp-*"))
        (disk / "ballast").unlink()
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        small(disk / "data", 3)
        assert_whole(disk / "data", 3, reference)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_write_that_fails_leaves_no_half_file(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    journal = begin(recorded, tmp_path / "data", without=1)

    def fail(handle: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputError, match="disk"):
        small(tmp_path / "data", 3)
    assert journal.missing() == [1]
    assert not list(journal.folder.glob(".*tmp*"))
