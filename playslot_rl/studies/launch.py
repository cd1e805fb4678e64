"""Jobs as processes: how each stands (`OUT/jobs/NAME.status.json`), the locks, and starting them.

Each is a process of its own, one after the other, or by a Hydra launcher: a job that dies of anything (out of memory, a
crash of a library) takes no other with it.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.config.plain import from_dict
from playslot_rl.errors import ConfigError, OutputError, PlaySlotError
from playslot_rl.storage.atomic import explain_write_errors, json_or_nothing, write_json
from playslot_rl.storage.locks import locked

LOCK: Final = "comparison.lock"
JOB_MODULE: Final = "playslot_rl.recipes.compare_job"
SWEEP_MODULE: Final = "playslot_rl.recipes.compare_sweep"


@dataclass(frozen=True)
class Status:
    """How a job stands: the fingerprint that it had when this was written, one line of error of a failed job, and
    wall-clock seconds of the process that wrote this.
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
        return from_dict(Status, json_or_nothing(job_file.with_suffix(".status.json")))
    except ValueError:
        return Status()


def write_status(job_file: Path, status: Status) -> None:
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


def job_command(job_file: Path) -> list[str]:
    return [sys.executable, "-m", JOB_MODULE, str(job_file)]


def run_process(job_file: Path) -> Status:
    """Run one job in a process of its own and wait for it; what it prints goes to its log. `failed` if it died."""
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
    """The command that gives jobs to a Hydra launcher: a multirun over the names of their files, in one folder."""
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


def require_launcher(name: str) -> None:
    """Refuse a launcher that is not installed; none is needed for an empty name.

    Raises:
        ConfigError: it is not.
    """
    if name and not _installed(LAUNCHERS[name]):
        raise ConfigError(
            f"hydra.launcher: got {name}, expected an installed launcher: install it by `uv pip install -e "
            "'.[launchers]'`"
        )


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # of the package it is in
        return False


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
