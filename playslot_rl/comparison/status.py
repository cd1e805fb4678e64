"""How a job stands: `OUT/jobs/NAME.status.json`, and the lock that lets one process at a time work on it."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

from playslot_rl.config.plain import from_dict
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


def status_file(job_file: Path) -> Path:
    """`NAME.status.json` beside `NAME.json`."""
    return job_file.with_suffix(".status.json")


def log_file(job_file: Path) -> Path:
    """`NAME.log` beside `NAME.json`: what the job printed."""
    return job_file.with_suffix(".log")


def read_status(job_file: Path) -> Status:
    """The stored status; `waiting` where there is none, or no readable one."""
    try:
        return from_dict(Status, json.loads(status_file(job_file).read_text()))
    except (OSError, ValueError):
        return Status()


def write_status(job_file: Path, status: Status) -> None:
    """Store a status.

    Raises:
        OutputError: full disk.
    """
    write_json(status_file(job_file), asdict(status))


def comparison_lock(out: Path) -> AbstractContextManager[None]:
    """Keep other commands out of a comparison's folder; `OUT/comparison.lock` also marks it as one.

    Raises:
        OutputError: another command works on it, or the folder cannot be written.
    """
    with explain_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    busy = (
        f"out={out}: got a folder that another `playslot compare` works on, expected one of its own: wait for it, or "
        "use another out="
    )
    return locked(out / LOCK, busy)


def job_lock(job_file: Path) -> AbstractContextManager[None]:
    """Wait until no other process works on the job."""
    return locked(job_file.with_suffix(".lock"))
