"""Faults while collecting: what was complete stays, the same command carries on, no seed is missing or double."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import pytest

from playslot_rl.collectors import collect, recording
from playslot_rl.collectors.episodes import Job, record
from playslot_rl.collectors.journal import Journal, journal_path
from playslot_rl.collectors.recording import record_into
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.collectors.workers import Report
from playslot_rl.config import CollectorConfig, ExperimentConfig, from_dict
from playslot_rl.errors import ConfigError, OutputError, PlaySlotError

STEPS = 3
SMALL: dict[str, Any] = {
    "env": {"image_size": 32, "warmup_steps": 1},
    "render": {"supersample": 1},
    "logging": {"progress": False},
}


def config(**changes: Any) -> ExperimentConfig:
    return from_dict(ExperimentConfig, {**SMALL, **changes})


def spec_of(episodes: int) -> CollectionSpec:
    return CollectionSpec.make(config(), "random", episodes, STEPS, 0)


def small(out: Path, episodes: int) -> Path:
    return collect(config(), "random", episodes, STEPS, out, seed=0, workers=1)


def assert_whole(out: Path, episodes: int, reference: list[Any] | None = None) -> None:
    """Every seed once and in order, every row there, frames as an undisturbed process records them; nothing beside."""
    columns = ["index", "episode_index", "frame_index", "seed", "observation.images.front"]
    rows = [
        row
        for file in sorted((out / "data").rglob("*.parquet"))
        for row in parquet.read_table(file, columns=columns).to_pylist()
    ]
    each = STEPS + 1
    assert [row["index"] for row in rows] == list(range(episodes * each))
    assert [row["seed"] for row in rows] == [i for i in range(episodes) for _ in range(each)]
    assert [row["episode_index"] for row in rows] == [i for i in range(episodes) for _ in range(each)]
    assert [row["frame_index"] for row in rows] == list(range(each)) * episodes
    record_file = json.loads((out / "meta" / "playslot.json").read_text())
    assert [e["seed"] for e in record_file["episodes"]] == list(range(episodes))
    assert json.loads((out / "meta" / "info.json").read_text())["total_episodes"] == episodes
    assert not journal_path(out).exists()
    assert not out.with_name(f".{out.name}.export").exists()
    for index, images in enumerate(reference or []):
        assert [row["observation.images.front"]["bytes"] for row in rows[index * each : (index + 1) * each]] == images


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journal of three episodes, recorded in this process without faults."""
    folder = tmp_path_factory.mktemp("recorded") / "data.journal"
    journal = Journal(folder, spec_of(3))
    for episode in record(journal.spec, range(3)):
        journal.add(episode)
    return folder


@pytest.fixture(scope="module")
def reference(recorded: Path) -> list[Any]:
    """PNGs of the first three episodes."""
    journal = Journal(recorded, spec_of(3))
    return [journal.read_with_images(index)[1] for index in range(3)]


def begin(recorded: Path, out: Path, without: int | None = None) -> Journal:
    """A journal of three episodes for `out`, one of them missing."""
    shutil.copytree(recorded, journal_path(out))
    journal = Journal(journal_path(out), spec_of(3))
    if without is not None:
        journal.path(without).unlink()
    return journal


# --- handing out, with workers that are not processes ----------------------------------------------------------------


class ScriptedWorkers:
    """Workers that store made-up content at once, but for the faults they are told of."""

    def __init__(self, journal: Journal, count: int, dies: dict[int, int], hangs: dict[int, int]) -> None:
        self.journal, self.dies, self.hangs = journal, dies, hangs
        self.queues: list[list[Job]] = [[] for _ in range(count)]
        self.alive = [False] * count
        self.recorded: list[int] = []
        self.killed: list[int] = []
        self.starts = 0

    def start(self, slot: int) -> None:
        assert not self.alive[slot]
        self.alive[slot], self.queues[slot] = True, []
        self.starts += 1

    def submit(self, slot: int, job: Job) -> None:
        assert self.alive[slot]
        assert job.seed == self.journal.spec.episode_seed(job.index)
        self.queues[slot].append(job)

    def reports(self, timeout: float) -> list[Report]:
        found = []
        for slot, queue in enumerate(self.queues):
            if not queue or not self.alive[slot]:
                continue
            index = queue[0].index
            if self.hangs.get(index, 0):
                continue
            if self.dies.get(index, 0):
                self.dies[index] -= 1
                self.alive[slot] = False
                found.append(Report(slot, dead="ended with SIGKILL"))
                continue
            self.recorded.append(queue.pop(0).index)
            found.append(Report(slot, index=index))
        return found

    def kill(self, slot: int) -> None:
        self.killed.append(slot)
        self.alive[slot] = False
        if self.queues[slot]:
            self.hangs[self.queues[slot][0].index] -= 1

    def close(self) -> None:
        self.alive = [False] * len(self.alive)


def run_scripted(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    settings: CollectorConfig,
    episodes: int = 9,
    **faults: dict[int, int],
) -> tuple[list[int], ScriptedWorkers, list[str]]:
    pools: list[ScriptedWorkers] = []

    def make(journal: Journal, count: int) -> ScriptedWorkers:
        pools.append(ScriptedWorkers(journal, count, faults.get("dies", {}), faults.get("hangs", {})))
        return pools[-1]

    monkeypatch.setattr(recording, "LocalWorkers", make)
    monkeypatch.setattr(recording, "check_rendering", lambda: None)
    monkeypatch.setattr(recording, "START_S", 0.0)
    said: list[str] = []
    journal = Journal(tmp_path / "journal", spec_of(9))
    try:
        found = list(record_into(journal, range(9), 3, settings, said.append))
    finally:
        assert not any(pools[0].alive)
    return found, pools[0], said


def test_each_episode_is_handed_out_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, pool, said = run_scripted(tmp_path, monkeypatch, CollectorConfig())
    assert sorted(found) == sorted(pool.recorded) == list(range(9))
    assert (pool.starts, said) == (3, [])


def test_dead_workers_are_replaced_and_their_episodes_recorded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, pool, said = run_scripted(tmp_path, monkeypatch, CollectorConfig(restarts=3), dies={1: 2, 8: 1})
    assert sorted(found) == sorted(pool.recorded) == list(range(9))
    assert pool.starts == 3 + 3
    assert len(said) == 3
    assert "SIGKILL" in said[0]


def test_a_worker_that_hangs_is_killed_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = CollectorConfig(timeout_s=1e-4, restarts=2)
    found, pool, said = run_scripted(tmp_path, monkeypatch, settings, hangs={4: 1})
    assert sorted(found) == list(range(9))
    assert len(pool.killed) == 1
    assert "gave no episode" in said[0]


def test_too_many_dead_workers_end_the_collection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PlaySlotError, match=r"collector\.restarts=2.*the same command carries on"):
        run_scripted(tmp_path, monkeypatch, CollectorConfig(restarts=2), dies={0: 99})


def test_missing_ray_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from playslot_rl.collectors import ray_workers

    monkeypatch.setattr(ray_workers.importlib.util, "find_spec", lambda name: None)
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


@contextlib.contextmanager
def tiny_disk(folder: Path, kib: int) -> Iterator[Path]:
    """A file system that is really full at `kib`; skips where this user may not mount."""
    folder.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(folder)], capture_output=True)
    if mount.returncode:
        pytest.skip(f"may not mount: {mount.stderr.decode().strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


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
        assert not (disk / ".data.export").exists()
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


# --- really killing processes ----------------------------------------------------------------------------------------

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


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def session_of(pid: int) -> list[int]:
    """Processes of the session that `pid` leads, itself left out: orphans stay in it."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rsplit(")", 1)[1].split()
            if int(fields[3]) == pid and fields[0] != "Z" and int(path.parent.name) != pid:
                found.append(int(path.parent.name))
    return found


def workers_of(pid: int) -> list[int]:
    """Collector processes of a parent (not multiprocessing's resource tracker)."""
    found = []
    for child in session_of(pid):
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
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
    assert "gave no episode for 8 s: another takes its place" in errors
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
    assert errors.startswith("one line: a collector worker ended with SIGKILL")
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
