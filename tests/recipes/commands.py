"""Running `playslot` commands in this process, and looking at what they leave on disk."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import multiprocessing
import re
import signal
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

from playslot_rl import cli
from playslot_rl.recipes import compare_job
from playslot_rl.storage.locks import locked
from playslot_rl.studies import launch
from playslot_rl.studies.launch import Status

ONE_CORE = ("threads=1", "workers=1", "device=cpu")


@dataclass(frozen=True)
class Done:
    """What a command did: exit code, standard output, standard error."""

    code: int
    out: str
    err: str


def playslot(*arguments: str) -> Done:
    """Run a command as the console script would, without paying for the imports again."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(arguments)
    return Done(code, out.getvalue(), err.getvalue())


def finished_pipeline(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> tuple[Path, Done]:
    """The run folder of `pipeline preset=smoke` and what the command said; made once for all of pytest's workers."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    run, said = shared / "smoke" / "run", shared / "smoke.json"
    with locked(said.with_suffix(".lock")):
        if not said.is_file():
            done = playslot("pipeline", "preset=smoke", f"out={run}", "episodes=2", *ONE_CORE)
            said.write_text(json.dumps(asdict(done)))
    done = Done(**json.loads(said.read_text()))
    assert done.code == 0, done.err
    return run, done


def instead(first: Sequence[object], *later: object) -> list[object]:
    """Arguments, each key once: a later one takes the place of an earlier one."""
    return list({str(argument).partition("=")[0]: argument for argument in (*first, *later)}.values())


def smoke(command: str, *arguments: object, noted: Sequence[str] = ()) -> Done:
    """A command of preset smoke that must succeed and be silent on standard error, but for these notes, a line each."""
    done = playslot(command, *_defaults(arguments), *map(str, arguments), *ONE_CORE)
    assert done.code == 0, done.err
    lines = done.err.splitlines()
    assert len(lines) == len(noted), done.err
    assert all(note in line for note, line in zip(noted, lines, strict=True)), done.err
    return done


def run_jobs_here(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let comparisons run their jobs in this process; returns the jobs' names, in the order in which they start."""
    names: list[str] = []

    def here(file: Path) -> Status:
        names.append(file.stem)
        return compare_job.main(file)

    monkeypatch.setattr(launch, "run_process", here)
    return names


def refused(command: str, *arguments: object, message: str, code: int = 1) -> Done:
    """A command that must fail with one line that matches `message`, and without a traceback."""
    done = playslot(command, *map(str, instead((*_defaults(arguments), *ONE_CORE), *arguments)))
    assert done.code == code, (done.code, done.err)
    assert_one_line(done.err, command)
    assert re.search(message, done.err), done.err
    return done


def assert_one_line(err: str, command: str) -> None:
    """One line that names the command, and no error that nobody thought of."""
    assert err.count("\n") == 1, err
    assert err.startswith(f"playslot {command}: error: "), err
    assert "unexpected" not in err, err


def _defaults(arguments: tuple[object, ...]) -> tuple[str, ...]:
    """Preset smoke, where no run brings its own config and the caller names none."""
    texts = [str(argument) for argument in arguments]
    own_config = any(text.startswith("run=") and text != "run=pretrained" for text in texts)
    named = any(text.startswith("preset=") for text in texts)
    return () if own_config or named else ("preset=smoke",)


def killed_at_first_checkpoint(folder: Path, *command: object) -> None:
    """Run a command in a process of its own, and kill it (SIGKILL) when its stage's first checkpoint is there.

    The process starts from a server that has the imports already. It calls `cli.main`, which it finds by name wherever
    the tests lie: other packages install a module `tests` too.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchrl.objectives", "torchvision", "playslot_rl.storage.checkpoints"])
    process = context.Process(target=cli.main, args=(list(map(str, command)),))
    process.start()
    limit = time.monotonic() + 120
    while not list((folder / "checkpoints").glob("step_*")) and time.monotonic() < limit:
        assert process.is_alive(), "finished before it could be killed"
        time.sleep(0.002)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert not (folder / "checkpoint").exists()


def contents(folder: Path) -> dict[str, str]:
    """Relative path -> hash of every file below a folder; also of hidden and temporary ones."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sorted(folder.rglob("*"))
    }


def weights(run: Path, stage: str) -> bytes:
    """The weights of a finished stage."""
    return (run / stage / "checkpoint" / "weights.safetensors").read_bytes()
