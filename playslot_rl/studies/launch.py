"""Jobs as processes: how each stands (`OUT/jobs/NAME.status.json`), the locks, and starting them.

Each is a process of its own, one after the other, or by a Hydra launcher: a job that dies of anything (out of memory, a
crash of a library) takes no other with it. It holds its lock, writes its status and evaluates; only its training may be
several processes of one machine, started by torchrun, each of which takes a free port of its own.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import IO, Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.config.compose import spelled
from playslot_rl.config.plain import from_dict
from playslot_rl.errors import ConfigError, OutputError, PlaySlotError
from playslot_rl.runs.opening import run_to_write
from playslot_rl.runtime.processes import end_with_parent
from playslot_rl.storage.atomic import explain_write_errors, json_or_nothing, write_json
from playslot_rl.storage.locks import locked
from playslot_rl.visualization.charts import draw_curve

LOCK: Final = "comparison.lock"
JOB_MODULE: Final = "playslot_rl.recipes.compare_job"
SWEEP_MODULE: Final = "playslot_rl.recipes.compare_sweep"


@dataclass(frozen=True)
class Status:
    """How a job stands: the fingerprint that it had when this was written, one line of error of a failed job,
    wall-clock seconds of the process that wrote this, its commit and its processor.
    """

    status: Literal["waiting", "running", "done", "failed"] = "waiting"
    fingerprint: str = ""
    error: str = ""
    seconds: float = 0.0
    commit: str = ""
    processor: str = ""


def log_file(job_file: Path) -> Path:
    """`NAME.log` beside `NAME.json`: what the job printed."""
    return job_file.with_suffix(".log")


def read_status(job_file: Path, fingerprint: str | None = None) -> Status:
    """How a job stands; with other settings, data or parents than those of a fingerprint it waits."""
    try:
        status = from_dict(Status, json_or_nothing(job_file.with_suffix(".status.json")))
    except ValueError:
        return Status()
    return status if fingerprint in (None, status.fingerprint) else Status()


def write_status(job_file: Path, status: Status) -> None:
    write_json(job_file.with_suffix(".status.json"), asdict(status))


def comparison_lock(out: Path) -> AbstractContextManager[None]:
    """Keep other commands out of a comparison's folder; `OUT/comparison.lock` also marks it as one. An OutputError
    where another command works on it, or it cannot be written.
    """
    with explain_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    busy = (
        f"out={out}: got a folder that another comparison works on, expected one of its own: wait for it, or "
        "use another out="
    )
    return locked(out / LOCK, busy)


def job_lock(job_file: Path) -> AbstractContextManager[None]:
    return locked(job_file.with_suffix(".lock"))


def open_comparison(out: Path) -> None:
    """Refuse a folder that holds something else than a comparison, by an OutputError."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"out={out}: got a file, expected a folder: choose another out=")
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    if names and (not names & {LOCK, "jobs"} or names & {"meta", "config.json"}):
        raise OutputError(f"out={out}: got a folder that holds something else, expected none: choose another out=")


def of_tasks(out: Path) -> bool:
    """Whether a folder holds a comparison of several tasks, each in a folder of its own; one of one task has jobs."""
    return (out / LOCK).is_file() and not (out / "jobs").is_dir() and any(out.glob(f"*/{LOCK}"))


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
    """How a job stands whose process ended; `failed` if it died, before it wrote a status, too."""
    fingerprint = json_or_nothing(job_file).get("fingerprint")
    status = read_status(job_file, fingerprint)
    if code != 0 and status.status != "failed":
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        hint = " (killed, perhaps out of memory)" if code == -9 else ""
        died = f"the job's process ended with {reason}{hint}; see {log_file(job_file).name}"
        status = Status("failed", fingerprint or status.fingerprint, died, status.seconds)
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
    """Refuse a launcher that is not installed, by a ConfigError; none is needed for an empty name."""
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
    """Run jobs by a Hydra launcher and wait for all of them; a PlaySlotError where the launcher itself failed."""
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


PATIENCE_S: Final = 30.0
"""What torchrun is given to end its processes when the job is interrupted."""
ERROR: Final = re.compile(r"playslot [a-z-]+(?: \(rank \d+\))?: error: (.*)")


def train(command: str, config: ExperimentConfig, processes: int = 1) -> None:
    """Do what `train-slots`, `train-dynamics` or `train-baseline` does, here or on several processes."""
    if processes > 1:
        train_on_several(command, config, processes)
        return
    from playslot_rl.methods import training
    from playslot_rl.methods.playslot.method import DYNAMICS, SLOTS

    stage = {"train-slots": SLOTS, "train-dynamics": DYNAMICS}.get(command)
    if stage is not None:
        training.train_stage(stage, config, run_to_write(config))
    else:
        draw_curve(training.train(config).path.parent, config.method)


def training_command(command: str, config: ExperimentConfig, processes: int) -> list[str]:
    """`torchrun --standalone --nproc-per-node=N -m playslot_rl COMMAND key=value ...`; a ConfigError where no arguments
    make the config.
    """
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    return [*torchrun, "-m", "playslot_rl", command, *spelled(config, command)]


def train_on_several(command: str, config: ExperimentConfig, processes: int) -> None:
    """Run a training command on several processes and wait for it; what they print goes where this one's does. A
    PlaySlotError where it failed, with the one line that it said; after Ctrl-C torchrun has ended its processes.
    """
    started = training_command(command, config, processes)
    # A job that is killed takes torchrun, and that its processes, with it.
    tied = partial(end_with_parent, signal.SIGTERM)
    with _ended(subprocess.Popen(started, stderr=subprocess.PIPE, text=True, preexec_fn=tied)) as process:
        said = _relay(process.stderr)
        code = process.wait()
    if code != 0:
        raise PlaySlotError(said or f"{command} on {processes} processes: ended with exit code {code}; see the log")


def _relay(lines: IO[str] | None) -> str:
    """Pass standard error on; the first line in which a process says what is wrong, or nothing."""
    said = ""
    for line in lines or ():
        sys.stderr.write(line)
        sys.stderr.flush()
        found = ERROR.search(line)
        said = said or (found[1].strip() if found else "")
    return said


@contextlib.contextmanager
def _ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()  # torchrun ends its processes, then itself
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
