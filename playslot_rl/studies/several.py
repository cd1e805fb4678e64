"""A job's training on several processes of one machine: the command under torchrun, and how it ended.

The job itself stays one process, which holds its lock, writes its status and evaluates; only the training in it is
started by torchrun. Any launcher may run such jobs side by side: each torchrun takes a free port of its own.
"""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import IO, Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.spelling import spelled
from playslot_rl.errors import PlaySlotError
from playslot_rl.runtime.children import end_with_parent

Commands = Mapping[str, Callable[[ExperimentConfig], object]]
"""The `playslot` commands that a study has run, by name: `train-slots`, `train-dynamics`, `train-baseline`, `evaluate`,
and `train-videos` for a model of unlabelled videos. They lie above it in the layers."""
PATIENCE_S: Final = 30.0
"""What torchrun is given to end its processes when the job is interrupted."""
ERROR: Final = re.compile(r"playslot [a-z-]+(?: \(rank \d+\))?: error: (.*)")


def train(command: str, config: ExperimentConfig, processes: int, commands: Commands) -> None:
    """Run a training command, here or on several processes; raises as it does."""
    if processes > 1:
        train_on_several(command, config, processes)
    else:
        commands[command](config)


def training_command(command: str, config: ExperimentConfig, processes: int) -> list[str]:
    """`torchrun --standalone --nproc-per-node=N -m playslot_rl COMMAND key=value ...`.

    Raises:
        ConfigError: no arguments make the config.
    """
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    return [*torchrun, "-m", "playslot_rl", command, *spelled(config, command)]


def train_on_several(command: str, config: ExperimentConfig, processes: int) -> None:
    """Run a training command on several processes and wait for it; what they print goes where this one's does.

    Raises:
        ConfigError: as `training_command`.
        PlaySlotError: it failed, with the one line that it said.
        KeyboardInterrupt: Ctrl-C; torchrun has ended its processes.
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
    """Whatever happens inside, the process is no more afterwards."""
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
