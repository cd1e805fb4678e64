"""Starting jobs: how a process ended, one at a time, and the command for Hydra."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from pathlib import Path

import pytest

from playslot_rl.errors import PlaySlotError
from playslot_rl.storage.atomic import write_json
from playslot_rl.studies import launch
from playslot_rl.studies.launch import Status, job_lock, log_file, read_status, write_status


@pytest.fixture
def job(tmp_path: Path) -> Path:
    file = tmp_path / "jobs" / "lapo-d10-s0.json"
    file.parent.mkdir()
    file.write_text("{}")
    return file


def test_a_status_survives_and_a_damaged_one_is_waiting(job: Path) -> None:
    assert read_status(job) == Status()
    write_status(job, Status("failed", "f", "why", 2.5))
    assert read_status(job) == Status("failed", "f", "why", 2.5)
    job.with_suffix(".status.json").write_text("{")
    assert read_status(job) == Status()


def test_a_process_that_died_is_a_failure_that_says_of_what(job: Path) -> None:
    write_status(job, Status("running", "f"))
    assert "signal 9 (killed, perhaps out of memory)" in launch.settle(job, -9).error
    assert read_status(job).status == "failed"


@pytest.mark.parametrize("before", [None, Status("done", "old"), Status("failed", "old", "loss is nan")])
def test_a_process_that_died_before_it_wrote_a_status_is_this_jobs_failure(job: Path, before: Status | None) -> None:
    write_json(job, {"fingerprint": "new"})
    if before is not None:
        write_status(job, before)
    launch.settle(job, -9)
    found = read_status(job)
    assert (found.status, found.fingerprint) == ("failed", "new")
    assert "signal 9" in found.error


def test_an_error_the_job_reported_itself_is_kept(job: Path) -> None:
    write_status(job, Status("failed", "f", "loss is nan", 1.0))
    assert launch.settle(job, 1).error == "loss is nan"
    write_status(job, Status("done", "f", "", 1.0))
    assert launch.settle(job, 0).status == "done"


def test_what_a_job_prints_goes_to_its_log(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import os, sys; print('working'); sys.stdout.flush(); os.abort()"
    monkeypatch.setattr(launch, "job_command", lambda file: [sys.executable, "-c", code])
    status = launch.run_process(job)
    assert "signal 6" in status.error
    assert "working" in log_file(job).read_text()


def _hold(file: Path, started: str, seconds: float) -> None:
    import time

    with job_lock(file):
        Path(started).touch()
        time.sleep(seconds)


@pytest.mark.integration
def test_a_second_process_waits_for_the_lock(job: Path, tmp_path: Path) -> None:
    import time

    started = tmp_path / "started"
    process = multiprocessing.get_context("fork").Process(target=_hold, args=(job, str(started), 0.5))
    process.start()
    while not started.exists():
        time.sleep(0.01)
    began = time.monotonic()
    with job_lock(job):
        assert time.monotonic() - began > 0.2
    process.join()


def test_hydra_accepts_the_names_and_folders_it_is_given(tmp_path: Path) -> None:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    folder = tmp_path / "a folder, with = signs" / "jobs"
    files = [folder / f"{name}.json" for name in ("lapo-d10-s0", "dreamer-s1")]
    command = launch.sweep_command(files, "joblib", ["hydra.launcher.n_jobs=2"])
    overrides = OverridesParser.create().parse_overrides(command[command.index("--multirun") + 1 :])
    values = {override.key_or_group: override for override in overrides}
    assert values["hydra/launcher"].value() == "joblib"
    assert list(values["job"].sweep_iterator()) == ["lapo-d10-s0", "dreamer-s1"]
    assert values["folder"].value() == str(folder.resolve())
    assert values["hydra.launcher.n_jobs"].value() == 2


def test_a_launcher_that_fails_is_one_error(job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        options["stdout"].write("no such queue\n")  # type: ignore[attr-defined]
        options["stdout"].flush()  # type: ignore[attr-defined]
        return subprocess.CompletedProcess(command, 3)

    monkeypatch.setattr(launch.subprocess, "run", broken)
    with pytest.raises(PlaySlotError, match=r"got exit code 3 \(no such queue\), expected 0"):
        launch.run_sweep([job], "submitit_slurm", [])
