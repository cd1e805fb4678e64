"""Commands under a launcher: one result, one error, one Ctrl-C. The launcher is torchrun's own agent, which forks its
ranks here from a process that has the imports already; slow tests start `torchrun` and `accelerate launch` themselves.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import ONE_CORE, smoke

from playslot_rl import cli
from playslot_rl.errors import TrainingError
from playslot_rl.runtime.processes import free_port
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.tensors import load_tensors
from playslot_rl.training.stage_slots import SlotsStage

pytestmark = pytest.mark.integration

SOON_S = 120
RANKS = 2


def _launch(arguments: list[str], out: Path, patch: Callable[[], None] | None) -> None:
    """What `torchrun --standalone --nproc-per-node=2 -m playslot_rl` does."""
    import torch
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    os.setpgrp()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    with out.open("w") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=RANKS,
        run_id=str(os.getpid()),
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        start_method="fork",
        monitor_interval=0.1,
    )
    elastic_launch(config, _rank)(arguments, patch)


def _rank(arguments: list[str], patch: Callable[[], None] | None) -> None:
    # A rank that torchrun starts does not inherit its agent's handlers; a forked one does.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.stdout, sys.stderr = (os.fdopen(os.dup(number), "w", buffering=1) for number in (1, 2))
    if patch is not None:
        patch()
    code = cli.main(arguments)
    sys.stdout.flush()
    if code:
        os._exit(code)


class Launched:
    """A command on two ranks."""

    def __init__(self, folder: Path, *arguments: object, patch: Callable[[], None] | None = None) -> None:
        self.log = folder / f"launched{len(list(folder.glob('launched*')))}.log"
        words = [*map(str, arguments), *ONE_CORE]
        context = multiprocessing.get_context("fork")
        self.process = context.Process(target=_launch, args=(words, self.log, patch))
        self.process.start()
        assert self.process.pid is not None
        self.group = self.process.pid

    def end(self) -> int:
        """The exit code, soon."""
        self.process.join(SOON_S)
        assert self.process.exitcode is not None, self.log.read_text()
        return self.process.exitcode

    def lines(self) -> list[str]:
        """The errors it printed."""
        return [line for line in self.log.read_text().splitlines() if line.startswith("playslot ")]

    def signal(self, number: int) -> None:
        """To all of its processes, as a terminal sends Ctrl-C; an agent that is killed leaves its ranks running."""
        os.killpg(self.group, number)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few random episodes."""
    data = tmp_path_factory.mktemp("data") / "random"
    smoke("collect", "preset=smoke", "policy=random", "episodes=4", f"out={data}")
    return data


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Callable[..., Launched]]:
    started: list[Launched] = []

    def start(*arguments: object, patch: Callable[[], None] | None = None) -> Launched:
        started.append(Launched(tmp_path, *arguments, patch=patch))
        return started[-1]

    yield start
    for one in started:
        try:
            one.signal(signal.SIGKILL)
        except ProcessLookupError:
            continue


def slots(run: Path, videos: Path, *more: str) -> tuple[str, ...]:
    return ("train-slots", "preset=smoke", f"data.root={videos}", f"out={run}", *more)


def assert_equal(one: Path, other: Path) -> None:
    """The finished slots of two runs, but for rounding, which Adam enlarges where gradients are small.

    Half of each batch lost makes a difference of 7e-3.
    """
    first, second = (load_tensors(run / "slots" / "checkpoint" / "weights.safetensors") for run in (one, other))
    assert first.keys() == second.keys()
    assert max(float((first[key] - second[key]).abs().max()) for key in first) < 1e-4


LONG = ("slots.steps=60", "slots.checkpoint_every=4", "slots.validate_every=30")


def test_a_command_gives_the_run_of_one_process(launch: Callable[..., Launched], tmp_path: Path, videos: Path) -> None:
    done = launch(*slots(tmp_path / "two", videos))
    assert done.end() == 0, done.log.read_text()
    smoke(*slots(tmp_path / "one", videos))
    assert_equal(tmp_path / "two", tmp_path / "one")
    said = done.log.read_text()
    assert said.count("held-out clips") == 1  # rank 0 alone
    assert len((tmp_path / "two" / "slots" / "metrics.jsonl").read_text().splitlines()) == len(
        (tmp_path / "one" / "slots" / "metrics.jsonl").read_text().splitlines()
    )
    again = launch(*slots(tmp_path / "two", videos))
    assert again.end() == 0
    assert again.log.read_text().count("finished before") == 1


def _rank_one_fails() -> None:
    original = SlotsStage.batch

    def batch(self: SlotsStage, step: int, generators: StepGenerators) -> object:
        if step == 3 and os.environ["RANK"] == "1":
            raise TrainingError("slots: got a rank that fails, expected none")
        return original(self, step, generators)

    SlotsStage.batch = batch  # type: ignore[method-assign, assignment]


def test_a_rank_that_dies_ends_the_others_with_its_error_in_one_line(
    launch: Callable[..., Launched], tmp_path: Path, videos: Path
) -> None:
    done = launch(*slots(tmp_path / "run", videos, *LONG), patch=_rank_one_fails)
    assert done.end() != 0
    assert done.lines() == ["playslot train-slots (rank 1): error: slots: got a rank that fails, expected none"]


def _rank_one_is_killed(run: Path, killed: Path) -> Callable[[], None]:
    """After the first checkpoint is written, which rank 0 does while the other goes on; says when in `killed`."""

    def patch() -> None:
        real = SlotsStage.batch

        def batch(stage: SlotsStage, step: int, generators: StepGenerators) -> object:
            if step == 4 and os.environ["RANK"] == "1":
                while not list((run / "slots" / "checkpoints").glob("step_*")):
                    time.sleep(0.02)
                killed.write_text(str(time.monotonic()))
                os.kill(os.getpid(), signal.SIGKILL)
            return real(stage, step, generators)

        SlotsStage.batch = batch  # type: ignore[method-assign, assignment]

    return patch


@pytest.mark.slow
def test_a_rank_that_is_killed_ends_the_others_within_seconds(
    launch: Callable[..., Launched], tmp_path: Path, videos: Path
) -> None:
    run, killed = tmp_path / "run", tmp_path / "killed"
    done = launch(*slots(run, videos, *LONG), patch=_rank_one_is_killed(run, killed))
    assert done.end() != 0
    assert time.monotonic() - float(killed.read_text()) < 20


@pytest.mark.slow
def test_an_error_of_all_ranks_is_said_once(launch: Callable[..., Launched], tmp_path: Path, videos: Path) -> None:
    done = launch(*slots(tmp_path / "run", videos, "slots.batch_size=3"))
    assert done.end() != 0
    assert len(done.lines()) == 1
    assert "slots.batch_size: got 3, expected a multiple of 2" in done.lines()[0]
    assert not (tmp_path / "run" / "slots").exists()


@pytest.mark.slow
def test_a_command_for_one_process_says_so(launch: Callable[..., Launched], tmp_path: Path) -> None:
    done = launch("collect", "preset=smoke", "episodes=2", f"out={tmp_path / 'data'}")
    assert done.end() != 0
    assert len(done.lines()) == 1
    assert "got 2 processes, expected one" in done.lines()[0]


@pytest.mark.parametrize("command", [("doctor",), ("cache", "list"), ("dataset", "info", "."), ("demo",)])
def test_none_of_the_others_starts_on_several(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    assert cli.main(command) == 1
    said = capsys.readouterr().err
    assert f"playslot {command[0]}: error: got 2 processes, expected one" in said
    assert said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_what_was_stopped_carries_on(
    launch: Callable[..., Launched], tmp_path: Path, videos: Path, number: signal.Signals
) -> None:
    run = tmp_path / "run"
    stopped = launch(*slots(run, videos, *LONG))
    deadline = time.monotonic() + SOON_S
    while not list((run / "slots" / "checkpoints").glob("step_*")):
        assert time.monotonic() < deadline, stopped.log.read_text()
        assert stopped.process.is_alive(), stopped.log.read_text()
        time.sleep(0.02)
    began = time.monotonic()
    stopped.signal(number)
    assert stopped.end() != 0
    assert time.monotonic() - began < 20
    if number == signal.SIGINT:
        assert len(stopped.lines()) == 1
        assert "carries on from step" in stopped.lines()[0]
    last = max((run / "slots" / "checkpoints").glob("step_*"))
    state = json.loads((last / "state.json").read_text())
    assert 0 < state["step"] < 60
    again = launch(*slots(run, videos, *LONG))
    assert again.end() == 0, again.log.read_text()
    rows = [json.loads(line)["step"] for line in (run / "slots" / "metrics.jsonl").read_text().splitlines()]
    assert rows == sorted(rows)
    assert rows[-1] == 60


TORCHRUN = [sys.executable, "-m", "torch.distributed.run"]
ACCELERATE = [sys.executable, "-m", "accelerate.commands.launch", "--cpu", "--mixed_precision=no"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "launchers",
    [
        [[*TORCHRUN, "--standalone", "--nproc-per-node=2"]],
        [[*ACCELERATE, "--dynamo_backend=no", "--num_machines=1", "--num_processes=2", "--main_process_port=0"]],
        [[*TORCHRUN, "--nnodes=2", "--nproc-per-node=1", "--rdzv-backend=c10d", "--rdzv-endpoint=PLACE"]] * 2,
    ],
    ids=["torchrun", "accelerate launch", "torchrun on two machines"],
)
def test_the_launchers_themselves(tmp_path: Path, videos: Path, launchers: list[list[str]]) -> None:
    place, started = f"127.0.0.1:{free_port()}", []
    for launcher in launchers:
        command = [part.replace("PLACE", place) for part in launcher]
        command += ["-m", "playslot_rl", *slots(tmp_path / "two", videos), *ONE_CORE]
        started.append(subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}))
    assert [process.wait(300) for process in started] == [0] * len(started)
    smoke(*slots(tmp_path / "one", videos))
    assert_equal(tmp_path / "two", tmp_path / "one")
