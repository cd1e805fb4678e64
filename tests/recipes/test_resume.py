"""Ctrl-C: the same command carries on and ends with the same weights, bit for bit; two commands share no run. Kills are
in tests/methods/test_contract.py and tests/faults.
"""

from __future__ import annotations

import json
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
from playslot_rl.runs.opening import run_to_write
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training import record
from playslot_rl.training.stage_slots import SlotsStage

pytestmark = pytest.mark.integration


def _wait_for_checkpoint(folder: Path, alive: Callable[[], bool]) -> None:
    limit = time.monotonic() + 60
    while time.monotonic() < limit and alive():
        if list(folder.glob("step_*")):
            return
        time.sleep(0.002)
    raise AssertionError(f"no checkpoint came up in {folder}")


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


def test_a_damaged_finished_stage_is_said_and_made_again_as_told(run: Path) -> None:
    command, kept = ("train-slots", f"out={run}", f"data.root={run}/data/random"), weights(run, "slots")
    folder = run / "slots" / "checkpoint"
    content = bytearray((folder / "weights.safetensors").read_bytes())
    content[-5] ^= 0xFF
    (folder / "weights.safetensors").write_bytes(content)
    refused(*command, message=f"changed or damaged; put it back, or delete {folder} and run `playslot train-slots`")
    shutil.rmtree(folder)
    smoke(*command)
    assert weights(run, "slots") == kept


def test_a_stage_finished_before_it_said_its_validation_is_told_by_the_runs_config(run: Path) -> None:
    command, path = ("train-slots", f"out={run}", f"data.root={run}/data/random"), run / "slots/checkpoint/meta.json"
    meta = json.loads(path.read_text())
    del meta["validation"]
    path.write_text(json.dumps(meta))
    assert "skipped" in smoke(*command).out
    refused(*command, "data.validation=0.5", message="data.validation: got 0.5, expected ")
    (run / "config.json").unlink()
    assert "skipped" in smoke(*command, "data.validation=0.5").out


@pytest.mark.parametrize("left", ["checkpoints/step_00000003", "decoder/checkpoints/step_00000003", "checkpoint/meta"])
def test_a_command_that_was_quicker_on_a_new_run_is_not_trained_over(tmp_path: Path, left: str) -> None:
    slots = record.StageRecord(METHODS["playslot"].stages[0], tmp_path / "run", compose())
    with slots.training() as begin:
        (slots.folder / left).mkdir(parents=True)  # begun and ended since this one looked
        with pytest.raises(OutputError, match="whose slots another command is training"):
            begin()
    assert not (tmp_path / "run" / "config.json").exists()


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
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_in_a_terminal_is_one_line_and_carries_on(
    by: signal.Signals, shared_run: Path, videos: Path, tmp_path: Path
) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    longer = ("slots.steps=32", "slots.checkpoint_every=4", "slots.validate_every=16", f"data.root={videos}")
    command = ("train-slots", "preset=smoke", f"out={stopped}", *longer)
    process = subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", *command, *ONE_CORE],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    _wait_for_checkpoint(stopped / "slots" / "checkpoints", lambda: process.poll() is None)
    process.send_signal(by)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert_one_line(err, "train-slots")
    assert "slots interrupted; the same command carries on from step " in err
    assert not (stopped / "slots" / "checkpoint").exists()
    smoke(*command)
    smoke("train-slots", f"out={whole}", *longer)
    assert weights(stopped, "slots") == weights(whole, "slots")


def test_a_killed_copy_of_a_parent_is_made_again(shared_run: Path, videos: Path, tmp_path: Path) -> None:
    """What a kill leaves of an adopted checkpoint: a temporary folder and no checkpoint."""
    run = tmp_path / "run"
    (run / "slots" / ".checkpoint.tmp-0123456789ab").mkdir(parents=True)
    (run / "slots" / ".checkpoint.tmp-0123456789ab" / "config.json").write_text("{")
    smoke("train-dynamics", f"run={shared_run}", f"out={run}", f"data.root={videos}")
    assert weights(run, "slots") == weights(shared_run, "slots")
    assert not [name for name in contents(run) if ".tmp-" in name]
