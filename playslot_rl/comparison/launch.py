"""Starting jobs: each is a process of its own, one after the other, or by a Hydra launcher.

A job that dies of anything (out of memory, a crash of a library) takes no other with it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from playslot_rl.comparison.status import Status, log_file, read_status, write_status
from playslot_rl.errors import PlaySlotError

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
