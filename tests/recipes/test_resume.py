"""Ctrl-C and kill -9: the same command carries on and ends with the same weights, bit for bit."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from commands import ONE_CORE, assert_one_line, contents, playslot, refused, smoke, weights
from torch import Tensor

from playslot_rl import cli
from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS, method_stage
from playslot_rl.errors import OutputError
from playslot_rl.runs.opening import STAGE_LOCK, run_to_write
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.locks import locked
from playslot_rl.training import record
from playslot_rl.training.stage_slots import SlotsStage

pytestmark = pytest.mark.integration

LONG = {
    "slots": ("slots.steps=32", "slots.checkpoint_every=4", "slots.validate_every=16"),
    "dynamics": ("dynamics.steps=32", "dynamics.checkpoint_every=4", "dynamics.validate_every=16"),
    "policy": ("behaviour.steps=100", "behaviour.decoder_steps=20", "behaviour.checkpoint_every=10"),
    "decoder": ("behaviour.steps=20", "behaviour.decoder_steps=200", "behaviour.checkpoint_every=10"),
}
FOLDERS = {"slots": "slots", "dynamics": "dynamics", "policy": "policy", "decoder": "policy/decoder"}


@pytest.fixture(scope="module")
def start() -> Callable[..., multiprocessing.process.BaseProcess]:
    """Start a command in a process of its own that has the imports already: it can be killed while it works."""
    context = multiprocessing.get_context("forkserver")
    parts = ("training.stage_slots", "training.stage_dynamics", "training.checkpoints", "data.slot_cache")
    context.set_forkserver_preload(["torchrl.data", *(f"playslot_rl.{part}" for part in parts)])

    def begin(command: str, *arguments: object) -> multiprocessing.process.BaseProcess:
        process = context.Process(target=cli.main, args=([command, *map(str, arguments), *ONE_CORE],))
        process.start()
        return process

    return begin


def _command(part: str, run: Path, videos: Path, demos: Path) -> tuple[str, ...]:
    stage = "policy" if part == "decoder" else part
    data = demos if stage == "policy" else videos
    return (f"train-{stage}", "preset=smoke", f"out={run}", f"data.root={data}", *LONG[part])


def _prepared(shared_run: Path, run: Path, part: str) -> Path:
    """A run that has what comes before a stage."""
    parents = {"slots": (), "dynamics": ("slots",)}.get(part, ("slots", "dynamics"))
    run.mkdir()
    for stage in parents:
        shutil.copytree(shared_run / stage, run / stage)
    return run


def _wait_for_checkpoint(folder: Path, alive: Callable[[], bool]) -> None:
    limit = time.monotonic() + 60
    while time.monotonic() < limit and alive():
        if list(folder.glob("step_*")):
            return
        time.sleep(0.002)
    raise AssertionError(f"no checkpoint came up in {folder}")


@pytest.mark.slow
@pytest.mark.parametrize("part", LONG)
def test_a_killed_stage_ends_with_the_weights_of_one_that_was_not(
    shared_run: Path, videos: Path, demos: Path, tmp_path: Path, part: str, start: Callable[..., object]
) -> None:
    whole, killed = (_prepared(shared_run, tmp_path / name, part) for name in ("whole", "killed"))
    smoke(*_command(part, whole, videos, demos))
    process = start(*_command(part, killed, videos, demos))
    assert isinstance(process, multiprocessing.process.BaseProcess)
    checkpoints = killed / FOLDERS[part] / "checkpoints"
    _wait_for_checkpoint(checkpoints, process.is_alive)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    stage = "policy" if part == "decoder" else part
    assert not (killed / stage / "checkpoint").exists()
    smoke(*_command(part, killed, videos, demos))
    assert weights(killed, stage) == weights(whole, stage)
    assert not [name for name in contents(killed) if ".tmp-" in name]
    meta = [json.loads((run / stage / "checkpoint" / "meta.json").read_text()) for run in (whole, killed)]
    assert meta[0]["metrics"] == meta[1]["metrics"]
    counted = [[(one["training"], one["steps"]) for one in found["sittings"]] for found in meta]
    assert len(counted[1]) == len(counted[0]) + 1  # the killed process, and the one that went on
    for found, own in zip(meta, counted, strict=True):
        assert sum(steps for training, steps in own if training == own[0][0]) == found["steps"]
        assert sum(one["seconds"] for one in found["sittings"]) == pytest.approx(found["seconds"], abs=0.1)


def test_an_interrupt_is_one_line_and_the_same_command_carries_on(
    shared_run: Path, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, original = tmp_path / "run", SlotsStage.batch

    def pressed(self: SlotsStage, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        if step == 4:
            signal.raise_signal(signal.SIGINT)
        return original(self, step, generators)

    command = ("train-slots", f"out={run}", f"data.root={videos}")
    with monkeypatch.context() as patch:
        patch.setattr(SlotsStage, "batch", pressed)
        refused(*command, message="slots interrupted; the same command carries on from step 3 ", code=130)
    smoke(*command)
    assert weights(run, "slots") == weights(shared_run, "slots")


TRAININGS = {
    "slots": ("train-slots",),
    "dynamics": ("train-dynamics",),
    "policy": ("train-policy",),
    **{
        method: ("train-baseline", f"method={method}")
        for method in ("slot_oracle", "resnet_oracle", "lapo", "caddy_policy", "dreamer", "sold")
    },
}


@pytest.mark.parametrize("stage", TRAININGS)
def test_a_stage_that_another_command_trains_is_refused(
    shared_run: Path, videos: Path, demos: Path, tmp_path: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record, "PATIENCE", 0.0)
    run = tmp_path / "run"
    folder = run / {"lapo": "lapo_model", "caddy_policy": "caddy"}.get(stage, stage)  # what each trains first
    folder.mkdir(parents=True)
    data = demos if stage not in ("slots", "dynamics") else videos
    own = () if stage in ("slots", "resnet_oracle", "lapo", "dreamer") else (f"run={shared_run}",)
    (run / "config.json").write_bytes((shared_run / "config.json").read_bytes())
    before = contents(run).keys()
    with locked(folder / STAGE_LOCK):
        busy = f"got a run whose {folder.name} another command is training, expected none: wait for it"
        refused(*TRAININGS[stage], "preset=smoke", *own, f"out={run}", f"data.root={data}", message=busy)
    assert contents(run).keys() == before | {f"{folder.name}/{STAGE_LOCK}"}


def test_a_new_run_is_one_commands_too(
    shared_run: Path, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second command comes while the first trains; the first does not notice."""
    run, original, said = tmp_path / "run", SlotsStage.batch, []
    command = ("train-slots", f"out={run}", f"data.root={videos}")
    monkeypatch.setattr(record, "PATIENCE", 0.0)

    def second(self: SlotsStage, step: int, generators: StepGenerators) -> Mapping[str, Tensor]:
        if step == 4:
            said.append(cli.main([*command, "preset=smoke", "seed=1", *ONE_CORE]))
        return original(self, step, generators)

    with monkeypatch.context() as patch:
        patch.setattr(SlotsStage, "batch", second)
        done = playslot(*command, "preset=smoke", *ONE_CORE)
    assert (said, done.code) == ([1], 0)
    assert_one_line(done.err, "train-slots")
    assert "another command is training" in done.err
    assert json.loads((run / "config.json").read_text())["seed"] == 0
    assert weights(run, "slots") == weights(shared_run, "slots")


@pytest.mark.parametrize("method", METHODS)
def test_a_kill_before_the_first_file_of_a_run_leaves_no_foreign_folder(tmp_path: Path, method: str) -> None:
    for names in ((), ("training.lock",)):
        out = tmp_path / f"{method}{len(names)}"
        (out / method_stage(method)).mkdir(parents=True)
        for name in names:
            (out / method_stage(method) / name).touch()
        assert run_to_write(compose([f"out={out}"])).folder == out
        (out / method_stage(method) / "photo.png").touch()
        if method_stage(method) not in ("slots", "dynamics", "policy"):
            with pytest.raises(OutputError, match="got a folder that holds something else"):
                run_to_write(compose([f"out={out}"]))


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_is_one_line_and_carries_on(shared_run: Path, videos: Path, tmp_path: Path) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    command = _command("slots", stopped, videos, videos)
    process = subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", *command, *ONE_CORE],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    _wait_for_checkpoint(stopped / "slots" / "checkpoints", lambda: process.poll() is None)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert_one_line(err, "train-slots")
    assert "slots interrupted; the same command carries on from step " in err
    assert not (stopped / "slots" / "checkpoint").exists()
    smoke(*command)
    smoke(*_command("slots", whole, videos, videos))
    assert weights(stopped, "slots") == weights(whole, "slots")


def test_a_killed_copy_of_a_parent_is_made_again(shared_run: Path, videos: Path, tmp_path: Path) -> None:
    """What a kill leaves of an adopted checkpoint: a temporary folder and no checkpoint."""
    run = tmp_path / "run"
    (run / "slots" / ".checkpoint.tmp-0123456789ab").mkdir(parents=True)
    (run / "slots" / ".checkpoint.tmp-0123456789ab" / "config.json").write_text("{")
    smoke("train-dynamics", f"run={shared_run}", f"out={run}", f"data.root={videos}")
    assert weights(run, "slots") == weights(shared_run, "slots")
    assert not [name for name in contents(run) if ".tmp-" in name]
