"""Jobs as processes: how each stands (`OUT/jobs/NAME.status.json`), the locks, and starting them.

Each is a process of its own, one after the other, or by a Hydra launcher: a job that dies of anything (out of memory, a
crash of a library) takes no other with it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from playslot_rl.config.plain import from_dict
from playslot_rl.errors import OutputError, PlaySlotError
from playslot_rl.storage.atomic import explain_write_errors, write_json
from playslot_rl.storage.locks import locked

LOCK: Final = "comparison.lock"


@dataclass(frozen=True)
class Status:
    """How a job stands.

    Attributes:
        status: `waiting`, `running`, `done` or `failed`.
        fingerprint: of the job as it was when this was written.
        error: one line, of a failed job.
        seconds: wall-clock seconds of the process that wrote this.
    """

    status: Literal["waiting", "running", "done", "failed"] = "waiting"
    fingerprint: str = ""
    error: str = ""
    seconds: float = 0.0


def log_file(job_file: Path) -> Path:
    """`NAME.log` beside `NAME.json`: what the job printed."""
    return job_file.with_suffix(".log")


def read_status(job_file: Path) -> Status:
    """The stored status; `waiting` where there is none, or no readable one."""
    try:
        return from_dict(Status, json.loads(job_file.with_suffix(".status.json").read_text()))
    except (OSError, ValueError):
        return Status()


def write_status(job_file: Path, status: Status) -> None:
    """Store a status.

    Raises:
        OutputError: full disk.
    """
    write_json(job_file.with_suffix(".status.json"), asdict(status))


def comparison_lock(out: Path) -> AbstractContextManager[None]:
    """Keep other commands out of a comparison's folder; `OUT/comparison.lock` also marks it as one.

    Raises:
        OutputError: another command works on it, or the folder cannot be written.
    """
    with explain_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    busy = (
        f"out={out}: got a folder that another comparison works on, expected one of its own: wait for it, or "
        "use another out="
    )
    return locked(out / LOCK, busy)


def job_lock(job_file: Path) -> AbstractContextManager[None]:
    """Wait until no other process works on the job."""
    return locked(job_file.with_suffix(".lock"))


def open_comparison(out: Path) -> None:
    """Refuse a folder that holds something else than a comparison.

    Raises:
        OutputError: it does.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"out={out}: got a file, expected a folder: choose another out=")
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    if names and (not names & {LOCK, "jobs"} or names & {"meta", "config.json"}):
        raise OutputError(f"out={out}: got a folder that holds something else, expected none: choose another out=")


class AnyJob(Protocol):
    """What is asked of a job: its name, its file, and which of several waves of a launcher it belongs to, from 0 on."""

    @property
    def name(self) -> str: ...
    @property
    def file(self) -> Path: ...
    @property
    def wave(self) -> int: ...


class Report[J: AnyJob](Protocol):
    """What gathers the jobs' results."""

    out: Path

    @property
    def jobs(self) -> Mapping[J, Mapping[str, Any]]:
        """All of them, with what their files say."""

    def ended(self, job: J) -> None:
        """Say how a job ended, and write what there is so far."""

    def write(self) -> Sequence[Mapping[str, Any]]:
        """Write everything."""


def run_due[J: AnyJob](command: str, report: Report[J], launcher: str, hydra: Sequence[str]) -> None:
    """Write every job's file, and run those that are not done as they stand there.

    Args:
        command: for the messages.
        report: the jobs, and who is told.
        launcher: Hydra's name of one; empty runs one after the other.
        hydra: further overrides for Hydra.

    Raises:
        PlaySlotError: the launcher itself failed.
        KeyboardInterrupt: Ctrl-C. In both cases what there is has been written.
    """
    due: dict[Path, J] = {}
    for job, record in report.jobs.items():
        write_json(job.file, record)
        status = read_status(job.file)
        if status.status == "done" and status.fingerprint == record["fingerprint"]:
            print(f"{job.name}: done before, skipped", flush=True)
        else:
            due[job.file] = job
    print(f"{command}: {len(due)} of {len(report.jobs)} jobs to run", flush=True)
    try:
        if due and launcher:
            for wave in sorted({job.wave for job in due.values()}):
                run_sweep([file for file, job in due.items() if job.wave == wave], launcher, hydra)
        else:
            for file, job in due.items():
                run_process(file)
                report.ended(job)
    except KeyboardInterrupt:
        report.write()
        raise KeyboardInterrupt(f"{command} interrupted; the same command carries on in {report.out}") from None
    except PlaySlotError:
        report.write()
        raise


JOB_MODULE = "playslot_rl.recipes.compare_job"
SWEEP_MODULE = "playslot_rl.recipes.compare_sweep"


def job_command(job_file: Path) -> list[str]:
    """The command that runs one job."""
    return [sys.executable, "-m", JOB_MODULE, str(job_file)]


def run_process(job_file: Path) -> Status:
    """Run one job in a process of its own and wait for it; what it prints goes to its log.

    Returns:
        How it ended; `failed` if the process died.
    """
    with log_file(job_file).open("a") as log:
        done = subprocess.run(
            job_command(job_file), stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False
        )
    return settle(job_file, done.returncode)


def settle(job_file: Path, code: int) -> Status:
    """The status after the job's process ended with an exit code; one that died is marked as failed."""
    status = read_status(job_file)
    if code != 0 and status.status != "failed":
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        hint = " (killed, perhaps out of memory)" if code == -9 else ""
        died = f"the job's process ended with {reason}{hint}; see {log_file(job_file).name}"
        status = Status("failed", status.fingerprint, died, status.seconds)
        write_status(job_file, status)
    return status


def sweep_command(files: Sequence[Path], launcher: str, overrides: Sequence[str]) -> list[str]:
    """The command that gives jobs to a Hydra launcher: a multirun over the names of their files.

    Args:
        files: of the jobs, in one folder.
        launcher: Hydra's name of it.
        overrides: further overrides for Hydra.
    """
    folder = files[0].parent.resolve()
    names = ",".join(file.stem for file in files)
    return [
        sys.executable,
        "-m",
        SWEEP_MODULE,
        "--multirun",
        f"hydra/launcher={launcher}",
        f"+job={names}",
        f"+folder='{folder}'",
        f"hydra.sweep.dir='{folder / 'hydra'}'",
        "hydra.sweep.subdir=${job}",
        "hydra.output_subdir=null",
        "hydra.job.chdir=false",
        *overrides,
    ]


def run_sweep(files: Sequence[Path], launcher: str, overrides: Sequence[str]) -> None:
    """Run jobs by a Hydra launcher and wait for all of them.

    Raises:
        PlaySlotError: the launcher itself failed.
    """
    log = files[0].parent / "launcher.log"
    with log.open("a") as file:
        done = subprocess.run(
            sweep_command(files, launcher, overrides), stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
        )
    if done.returncode != 0:
        lines = [line for line in log.read_text().splitlines() if line.strip()]
        last = lines[-1] if lines else "nothing"
        raise PlaySlotError(
            f"hydra.launcher={launcher}: got exit code {done.returncode} ({last}), expected 0; see {log}; "
            "the same command carries on"
        )
