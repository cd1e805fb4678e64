"""The fit loop: resuming, faults, logs."""

from __future__ import annotations

import contextlib
import errno
import json
import multiprocessing
import os
import shutil
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from toy_stage import ToyStage, toy_config, train

import playslot_rl.storage.resume as resume_module
from playslot_rl.config import LoggingConfig, Precision
from playslot_rl.errors import CheckpointError, ConfigError, OutputError, TrainingError
from playslot_rl.runtime import precision as precision_module
from playslot_rl.runtime.devices import device_name
from playslot_rl.runtime.precision import resolve_precision
from playslot_rl.storage.atomic import lock
from playslot_rl.storage.resume import sittings_of
from playslot_rl.storage.tensors import load_tensors, module_tensors, save_tensors
from playslot_rl.training.fit import Part, fit, own_checkpoints
from playslot_rl.training.logging import History, open_logger


def tensors(folder: Path, step: int) -> dict[str, torch.Tensor]:
    last = folder / "checkpoints" / f"step_{step:08d}"
    return load_tensors(last / "modules.safetensors") | load_tensors(last / "optimizer.safetensors")


def assert_equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    different = [key for key in one if not torch.equal(one[key], other[key])]
    assert different == []


def stop_at(monkeypatch: pytest.MonkeyPatch, step: int, error: BaseException) -> None:
    """Make the toy stage fail when it reaches a step."""
    original = ToyStage.batch

    def batch(self: ToyStage, number: int, generators: object) -> dict[str, torch.Tensor]:
        if number == step:
            raise error
        return original(self, number, generators)  # type: ignore[arg-type]

    monkeypatch.setattr(ToyStage, "batch", batch)


@pytest.mark.parametrize("step", [1, 3, 8, 11])
def test_a_resumed_run_ends_with_the_same_weights_buffers_and_optimiser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    train(tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, step, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts")
    stage, _, start = train(tmp_path / "parts")
    assert start == step - step % 3
    assert stage.steps_seen == 12 - start
    assert_equal(tensors(tmp_path / "parts", 12), tensors(tmp_path / "whole", 12))
    rows = [History(tmp_path / name / "metrics.jsonl").read() for name in ("whole", "parts")]
    for row in rows[0] + rows[1]:
        del row["seconds"]
    assert rows[0] == rows[1]


def test_training_changes_weights_and_codebook_but_not_the_frozen_part(tmp_path: Path) -> None:
    before = module_tensors(ToyStage().modules)
    train(tmp_path)
    after = tensors(tmp_path, 12)
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    assert "encoder.2.weight" not in changed
    assert {"encoder.0.weight", "encoder.1.running_mean", "decoder.weight"} <= changed
    assert any("quantizer" in key for key in changed)


@pytest.mark.integration
def test_a_run_killed_by_the_system_ends_with_the_same_weights(tmp_path: Path) -> None:
    process = multiprocessing.get_context("fork").Process(target=train, args=(tmp_path / "killed", 12, 0.1))
    process.start()
    deadline = time.monotonic() + 60
    while not (tmp_path / "killed" / "checkpoints" / "step_00000003").exists():
        assert time.monotonic() < deadline
        assert process.is_alive()
        time.sleep(0.01)
    process.kill()
    process.join()
    assert not (tmp_path / "killed" / "checkpoints" / "step_00000012").exists()
    assert train(tmp_path / "killed")[2] >= 3
    train(tmp_path / "whole")
    assert_equal(tensors(tmp_path / "killed", 12), tensors(tmp_path / "whole", 12))


def test_what_each_process_added_is_kept_and_adds_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for step in (4, 8):
        with monkeypatch.context() as patch:
            stop_at(patch, step, KeyboardInterrupt())
            with pytest.raises(KeyboardInterrupt):
                train(tmp_path)
    _, state, _ = train(tmp_path)
    found = sittings_of(tmp_path / "checkpoints", "toy")
    assert [sitting["steps"] for sitting in found] == [3, 3, 6]  # a checkpoint every 3 steps
    assert sum(sitting["seconds"] for sitting in found) == pytest.approx(state.seconds)
    assert all(sitting["seconds"] > 0 for sitting in found)
    assert {(sitting["training"], sitting["device"]) for sitting in found} == {
        ("toy", device_name(torch.device("cpu")))
    }
    train(tmp_path)  # which has nothing left to do
    assert sittings_of(tmp_path / "checkpoints", "toy") == found


def test_a_training_from_before_sittings_were_kept_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        stop_at(patch, 8, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path)
    path = tmp_path / "checkpoints" / "step_00000006" / "state.json"
    stored = json.loads(path.read_text())
    del stored["sittings"]
    path.write_text(json.dumps(stored))
    train(tmp_path)
    first, second = sittings_of(tmp_path / "checkpoints", "toy")
    assert (first["steps"], first["seconds"], first["device"]) == (6, stored["seconds"], "")
    assert second["steps"] == 6


def test_what_a_kill_left_half_written_is_removed(tmp_path: Path) -> None:
    leftover = tmp_path / "checkpoints" / ".step_00000099.tmp-0123"
    leftover.mkdir(parents=True)
    (leftover / "modules.safetensors").write_bytes(b"half")
    (tmp_path / "metrics.jsonl").write_text('{"step": 50, "split": "train"}\n{"step": 5')
    _, _, start = train(tmp_path)
    assert start == 0
    assert not leftover.exists()
    assert all(row["step"] <= 12 for row in History(tmp_path / "metrics.jsonl").read())


def test_what_another_process_is_writing_is_left_alone(tmp_path: Path) -> None:
    written = tmp_path / "checkpoints" / ".step_00000099.tmp-0123"
    written.mkdir(parents=True)
    handle = os.open(written, os.O_RDONLY)
    assert lock(handle)
    try:
        train(tmp_path)
        assert written.exists()
    finally:
        os.close(handle)
    train(tmp_path)
    assert not written.exists()


def test_a_finished_stage_is_not_trained_again(tmp_path: Path) -> None:
    _, first, _ = train(tmp_path)
    stage, second, start = train(tmp_path)
    assert stage.steps_seen == 0
    assert start == second.step == 12
    assert second.metrics == first.metrics
    assert second.metrics["step"] == 12


def test_two_checkpoints_are_kept_and_none_is_a_pickle(tmp_path: Path) -> None:
    train(tmp_path)
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert kept == ["step_00000009", "step_00000012"]
    suffixes = {path.suffix for path in (tmp_path / "checkpoints").rglob("*") if path.is_file()}
    assert suffixes == {".safetensors", ".json"}


def test_a_nan_loss_stops_and_keeps_the_last_good_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"loss is nan at step 8.*step_00000006") as caught:
        fit(Part("toy", ToyStage(nan_at=7), toy_config()), tmp_path, seed=3, identity={"data": "abc"})
    assert "\n" not in str(caught.value)
    train(tmp_path / "whole")
    _, _, start = train(tmp_path)
    assert start == 6
    assert_equal(tensors(tmp_path, 12), tensors(tmp_path / "whole", 12))


def test_a_nan_before_the_first_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="no checkpoint yet"):
        fit(Part("toy", ToyStage(nan_at=0), toy_config()), tmp_path, seed=3)


def test_an_infinite_gradient_of_a_finite_loss_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = ToyStage.loss

    def loss(self: ToyStage, *given: object) -> dict[str, torch.Tensor]:
        values = original(self, *given)  # type: ignore[arg-type]
        values["loss"] = values["loss"] + (values["error"] * 0).sqrt()
        return values

    monkeypatch.setattr(ToyStage, "loss", loss)
    with pytest.raises(TrainingError, match=r"gradient norm is (inf|nan) at step 1"):
        train(tmp_path)


@pytest.mark.parametrize(
    ("changes", "key"), [({"lr": 0.02}, "toy.optim.lr"), ({"steps": 20}, "toy.steps")], ids=["lr", "steps"]
)
def test_a_changed_config_is_refused(tmp_path: Path, changes: dict[str, float], key: str) -> None:
    train(tmp_path)
    before = tensors(tmp_path, 12)
    with pytest.raises(CheckpointError, match=f"^{key}: got .*, expected .*out=") as caught:
        fit(Part("toy", ToyStage(), toy_config(**changes)), tmp_path, seed=3, identity={"data": "abc"})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert_equal(tensors(tmp_path, 12), before)


@pytest.mark.parametrize(("seed", "data", "key"), [(4, "abc", "seed"), (3, "xyz", "data")])
def test_another_seed_or_data_set_is_refused(tmp_path: Path, seed: int, data: str, key: str) -> None:
    train(tmp_path)
    with pytest.raises(CheckpointError, match=f"^{key}: got"):
        fit(Part("toy", ToyStage(), toy_config()), tmp_path, seed=seed, identity={"data": data})


def test_intervals_may_change_when_resuming(tmp_path: Path) -> None:
    train(tmp_path)
    config = toy_config(checkpoint_every=5, log_every=1)
    state, _ = fit(Part("toy", ToyStage(), config), tmp_path, seed=3, identity={"data": "abc"})
    assert state.step == 12


@pytest.mark.parametrize("name", ["modules.safetensors", "optimizer.safetensors", "state.json"])
def test_a_truncated_checkpoint_is_refused(tmp_path: Path, name: str) -> None:
    train(tmp_path)
    path = tmp_path / "checkpoints" / "step_00000012" / name
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(CheckpointError, match="damaged") as caught:
        train(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_with_a_missing_tensor_is_refused(tmp_path: Path) -> None:
    train(tmp_path)
    path = tmp_path / "checkpoints" / "step_00000012" / "modules.safetensors"
    kept = load_tensors(path)
    del kept["decoder.bias"]
    save_tensors(path, kept)
    with pytest.raises(CheckpointError, match=r"misses tensor decoder\.bias"):
        train(tmp_path)


def test_a_full_disk_keeps_the_last_good_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = resume_module.save_tensors

    def full(path: Path, values: dict[str, torch.Tensor]) -> None:
        if "step_00000006" in str(path):
            (path.parent / "half").write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        original(path, values)

    with monkeypatch.context() as patch:
        patch.setattr(resume_module, "save_tensors", full)
        with pytest.raises(OutputError, match="the disk is full"):
            train(tmp_path)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step_00000003"]
    assert train(tmp_path)[2] == 3


def test_an_interrupt_says_where_it_carries_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stop_at(monkeypatch, 4, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt, match="carries on from step 3 "):
        train(tmp_path)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        train(tmp_path)
    assert (tmp_path / "checkpoints").read_text() == "mine"


def test_plain_progress_lines_where_there_is_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logging = LoggingConfig(backend="none", progress=True)
    fit(Part("toy", ToyStage(), toy_config(log_every=1)), tmp_path, seed=3, logging=logging)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == ["toy: step 10/12", "toy: step 12/12"]
    assert "steps/s" in lines[0]


def test_tensorboard_logs_are_written(tmp_path: Path) -> None:
    logging = LoggingConfig(backend="tensorboard", progress=False)
    fit(Part("toy", ToyStage(), toy_config()), tmp_path, seed=3, logging=logging)
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "logs"))
    events.Reload()
    assert [event.step for event in events.Scalars("toy/train/loss")] == [1, 2, 4, 6, 8, 10, 12]
    rows = [row for row in History(tmp_path / "metrics.jsonl").read() if row["split"] == "validation"]
    assert [row["step"] for row in rows] == [4, 8, 12]


def test_a_disk_that_fills_under_tensorboard_is_raised_and_not_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.summary.writer.record_writer import RecordWriter

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    printed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", printed.append)
    monkeypatch.setattr(RecordWriter, "write", full)
    logging = LoggingConfig(backend="tensorboard", progress=False)
    with pytest.raises(OSError, match="No space left"):
        fit(Part("toy", ToyStage(), toy_config()), tmp_path, seed=3, logging=logging)
    assert printed == []
    assert threading.excepthook == printed.append


def test_a_missing_logging_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ConfigError, match=r"playslot_rl\[wandb\]"):
        fit(Part("toy", ToyStage(), toy_config()), tmp_path, seed=3, logging=LoggingConfig(backend="wandb"))


@pytest.mark.parametrize(
    ("seed", "begun", "taken"), [(3, False, ["step_00000012"]), (4, False, []), (3, True, ["step_00000001"])]
)
def test_another_runs_checkpoint_is_taken_over_if_it_is_the_same_training(
    tmp_path: Path, seed: int, begun: bool, taken: list[str]
) -> None:
    train(tmp_path / "first")
    own = own_checkpoints(Part("toy", ToyStage(), toy_config()), tmp_path / "own", seed, {"data": "abc"}, str)
    if begun:
        (own.folder / "step_00000001").mkdir(parents=True)
    for step in (12, 99):  # the second was not reached
        own.take(tmp_path / "first" / "checkpoints" / f"step_{step:08d}")
    assert [path.name for path in own.saved()] == taken


def test_each_training_has_a_tracked_run_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[dict[str, Any]] = []
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **given: opened.append(given)))
    folders = [tmp_path / run / part for run in ("a/seed0", "b/seed0") for part in ("policy", "policy/decoder")]
    for folder in folders:
        open_logger(LoggingConfig(backend="wandb"), folder / "logs", 0)
    assert len({given["id"] for given in opened}) == len({given["name"] for given in opened}) == len(folders)
    assert all("seed0-policy" in given["name"] for given in opened)
    shutil.move(tmp_path / "a", tmp_path / "moved")  # and carried on
    open_logger(LoggingConfig(backend="wandb"), tmp_path / "moved" / "seed0" / "policy" / "logs", 4)
    assert opened[-1]["id"] == opened[0]["id"]


def test_the_stored_state_is_readable_json(tmp_path: Path) -> None:
    train(tmp_path)
    state = json.loads((tmp_path / "checkpoints" / "step_00000012" / "state.json").read_text())
    assert state["step"] == 12
    assert state["identity"]["toy"]["optim"]["lr"] == 0.01


@pytest.mark.parametrize("stored", [True, False], ids=["as now", "as before precisions were stored"])
@pytest.mark.parametrize("begun", ["auto", "fp32", "bf16"])
def test_a_training_goes_on_in_the_precision_it_began_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: Precision, stored: bool
) -> None:
    found: list[Precision] = []

    class Seen(ToyStage):
        def loss(self, *given: Any) -> dict[str, torch.Tensor]:
            found.append(resolve_precision("auto", "cpu"))
            return super().loss(*given)

    def trained(precision: Precision, steps: int) -> Precision:
        config = replace(toy_config(12), precision=precision)
        with pytest.raises(KeyboardInterrupt) if steps < 12 else contextlib.nullcontext(), monkeypatch.context() as by:
            if steps < 12:
                stop_at(by, steps, KeyboardInterrupt())
            fit(Part("toy", Seen(), config), tmp_path, seed=3)
        assert len(set(found)) == 1
        return found.pop()

    monkeypatch.setattr(precision_module, "native_bf16", lambda _: True)
    monkeypatch.setattr(precision_module, "bf16_pays", lambda _: False)
    first = trained(begun, 6)
    found.clear()
    monkeypatch.setattr(precision_module, "bf16_pays", lambda _: True)
    state = tmp_path / "checkpoints" / "step_00000006" / "state.json"
    values = json.loads(state.read_text())
    assert values["precision"] == ("fp32" if begun == "auto" else begun)
    if not stored:
        del values["precision"]
        state.write_text(json.dumps(values))
    assert first == values.get("precision", first)
    nobody_knows = begun == "auto" and not stored
    assert trained("auto", 12) == ("bf16" if nobody_knows else "fp32" if begun == "auto" else begun)
