"""Bad input, each through the command line: one line, a non-zero exit, nothing lost, nothing half-written."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import assert_one_line, contents, playslot, refused, smoke, weights

from playslot_rl.storage.tensors import load_tensors, save_tensors
from playslot_rl.training.stage_slots import SlotsStage

pytestmark = pytest.mark.integration

# --- arguments ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        (
            "env=button_pres",
            "unknown env 'button_pres': expected one of .*button_press.*; did you mean env=button_press",
        ),
        ("preset=smok", "unknown preset 'smok': expected one of .*; did you mean preset=smoke"),
        ("slots.optim.l=1", r"unknown key slots\.optim\.l: expected one of .*; did you mean slots\.optim\.lr"),
        ("episods=3", "unknown key episods: .*; did you mean episodes"),
        ("protocol=dreams", "protocol: got 'dreams', expected one of simulation, imagination"),
        ("env.image_size=63", "env.image_size: got 63, expected 32, 64 or 128"),
    ],
)
@pytest.mark.parametrize("command", ["pipeline", "collect"])
def test_unknown_arguments_are_refused_with_a_suggestion(
    command: str, argument: str, message: str, tmp_path: Path
) -> None:
    refused(command, f"out={tmp_path / 'new'}", argument, message=message, code=2)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_collector_policy_or_device_is_refused(videos: Path, tmp_path: Path) -> None:
    out = f"out={tmp_path / 'new'}"
    refused("collect", out, "policy=expart", message="policy: got 'expart', expected one of random, expert", code=2)
    done = playslot("train-slots", "preset=smoke", out, f"data.root={videos}", "device=gpu")
    assert done.code == 1
    assert_one_line(done.err, "train-slots")
    assert "device=gpu" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("device", ["meta", "cuda:99", "cpu:x"])
def test_a_device_that_computes_nothing_is_refused_before_anything_is_written(
    device: str, videos: Path, tmp_path: Path
) -> None:
    done = playslot("train-slots", "preset=smoke", f"out={tmp_path / 'new'}", f"data.root={videos}", f"device={device}")
    assert done.code == 1
    assert_one_line(done.err, "train-slots")
    assert f"device={device}: " in done.err
    assert "use device=cpu" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["collect", "train-slots", "train-dynamics", "train-policy", "evaluate"])
def test_a_command_without_its_folder_is_refused(command: str) -> None:
    refused(command, message="(out|run): got nothing, expected")


# --- data sets ----------------------------------------------------------------------------------------------------


def _break(root: Path, fault: str) -> None:
    data = next((root / "data").rglob("*.parquet"))
    if fault == "foreign":
        shutil.rmtree(root / "meta")
    elif fault == "old":
        info = root / "meta" / "info.json"
        info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    elif fault == "truncated":
        data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    elif fault == "unfinalised":
        shutil.rmtree(root / "meta" / "episodes")
    else:
        shutil.rmtree(root)


FAULTS = [
    ("missing", "no such folder, expected a LeRobot data set"),
    ("foreign", "got no meta/info.json, expected a LeRobot v3.0 data set"),
    ("old", "got LeRobot format v2.1, expected v3.0"),
    ("truncated", "got a parquet file without a footer, expected a whole one"),
    ("unfinalised", "got no rows under data/ and meta/episodes/, expected parquet files; it was never finalised"),
]


@pytest.mark.parametrize(("fault", "message"), FAULTS)
def test_a_bad_data_set_is_refused_by_every_stage(
    world: Path, videos: Path, tmp_path: Path, fault: str, message: str
) -> None:
    root = Path(shutil.copytree(videos, tmp_path / "set"))
    _break(root, fault)
    before = contents(world)
    refused("train-slots", f"out={tmp_path / 'new'}", f"data.root={root}", message=message)
    refused("train-policy", f"run={world}", f"data.demos={root}", message=message)
    shutil.rmtree(world / "dynamics")
    refused("train-dynamics", f"run={world}", f"data.root={root}", message=message)
    assert not (tmp_path / "new").exists()
    assert contents(world) == {name: value for name, value in before.items() if not name.startswith("dynamics")}


def test_a_wrong_camera_is_refused_with_the_names_of_the_cameras(foreign: Path, tmp_path: Path) -> None:
    out = f"out={tmp_path / 'new'}"
    names = "observation.images.top, observation.images.side"
    refused("train-slots", out, f"data.root={foreign}", message=rf"got 2 cameras \({names}\), expected one: set data.c")
    refused("train-slots", out, f"data.root={foreign}", "data.camera=wrist",
            message=f"data.camera=wrist: .* has no such camera, expected one of: {names}")  # fmt: skip
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_frame_size_is_refused_by_every_stage(run: Path, videos: Path, tmp_path: Path) -> None:
    before = contents(run)
    size = "got frames of 64x64 from .*, expected 32x32: set env.image_size"
    refused("train-slots", f"out={tmp_path / 'new'}", f"data.root={videos}", "env.image_size=32", message=size)
    for command in ("train-dynamics", "train-policy", "evaluate"):
        refused(command, f"run={run}", "env.image_size=32", message="env.image_size: got 32, expected 64")
    assert contents(run) == before
    assert not (tmp_path / "new").exists()


def test_too_short_episodes_and_too_few_demonstrations_are_refused(world: Path, videos: Path, tmp_path: Path) -> None:
    before = contents(world)
    refused("train-slots", f"out={tmp_path / 'new'}", f"data.root={videos}", "slots.clip_frames=8",
            message="got episodes of at most 7 frames .*, expected at least one of 8")  # fmt: skip
    refused("train-policy", f"run={world}", "behaviour.labelled_demos=7",
            message="behaviour.labelled_demos: got 7, expected at most the 6 demonstrations")  # fmt: skip
    assert contents(world) == before
    assert not (tmp_path / "new").exists()


# --- checkpoints --------------------------------------------------------------------------------------------------


def _retrain_slots(run: Path, videos: Path, tmp_path: Path) -> None:
    """Put slots of another seed in the place of a run's."""
    smoke("train-slots", f"out={tmp_path / 'other'}", f"data.root={videos}", "seed=1")
    shutil.rmtree(run / "slots")
    shutil.copytree(tmp_path / "other" / "slots", run / "slots")


def test_a_checkpoint_of_another_parent_is_refused(run: Path, videos: Path, tmp_path: Path) -> None:
    _retrain_slots(run, videos, tmp_path)
    before = contents(run)
    for command in ("train-dynamics", "train-policy", "evaluate"):
        refused(command, f"run={run}", message="was trained on slots [0-9a-f]{16}, got slots [0-9a-f]{16} at ")
    assert contents(run) == before


def test_a_run_with_stages_of_its_own_takes_no_others(
    run: Path, shared_run: Path, videos: Path, tmp_path: Path
) -> None:
    _retrain_slots(run, videos, tmp_path)
    shutil.rmtree(run / "dynamics")
    shutil.rmtree(run / "policy")
    before = contents(run)
    message = "has slots [0-9a-f]{16} of its own, got slots .*: leave run= out .*, or use another out="
    refused("train-dynamics", f"run={shared_run}", f"out={run}", message=message)
    refused("train-policy", f"run={shared_run}", f"out={run}", message=message)
    assert contents(run) == before


@pytest.mark.parametrize(
    ("command", "change", "key"),
    [
        ("train-slots", "model.savi.slot_dim=64", "model.savi.slot_dim: got 64, expected 32"),
        ("train-slots", "slots.steps=9", "slots.steps: got 9, expected 6"),
        ("train-slots", "seed=1", "seed: got 1, expected 0"),
        ("train-dynamics", "model.predictor.dim=64", "model.predictor.dim: got 64, expected 32"),
        ("train-dynamics", "dynamics.optim.lr=1", "dynamics.optim.lr: got 1.0, expected 0.001"),
        ("train-policy", "behaviour.labelled_demos=2", "behaviour.labelled_demos: got 2, expected 3"),
        ("train-policy", "model.policy.dim=64", "model.policy.dim: got 64, expected 32"),
    ],
)
def test_a_changed_config_is_refused_and_not_stored(
    run: Path, videos: Path, command: str, change: str, key: str
) -> None:
    before = contents(run)
    where = (f"out={run}", f"data.root={videos}") if command == "train-slots" else (f"run={run}",)
    refused(command, *where, change, message=f"{key}, with which|{key} as ")
    assert contents(run) == before


def test_other_data_than_a_stage_was_trained_on_are_refused(run: Path, videos: Path, demos: Path) -> None:
    before = contents(run)
    refused("train-slots", f"out={run}", f"data.root={demos}", message="data: got [0-9a-f]{16}, expected [0-9a-f]{16}")
    refused("train-dynamics", f"run={run}", f"data.root={demos}", message="data: got [0-9a-f]{16}, expected")
    refused("train-policy", f"run={run}", f"data.demos={videos}", message="data: got [0-9a-f]{16}, expected")
    assert contents(run) == before


@pytest.mark.parametrize("change", ["seed=1", "data.validation=0.5", "slots.steps=8"])
def test_a_stage_begun_otherwise_is_not_carried_on(run: Path, videos: Path, change: str) -> None:
    shutil.rmtree(run / "slots" / "checkpoint")
    before = contents(run)
    name = change.partition("=")[0]
    refused("train-slots", f"out={run}", f"data.root={videos}", change, message=f"{name}: got .*, with which .* begun")
    assert contents(run) == before


@pytest.mark.parametrize("stage", ["slots", "dynamics", "policy"])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("truncated", "was changed or damaged|is damaged"),
        ("missing tensors", "misses tensor|was changed or damaged"),
        ("no weights", "weights.safetensors is missing"),
        ("no meta", "no {stage} checkpoint at|got no policy/checkpoint"),
        ("broken meta", "meta.json is damaged|meta.json: got"),
        ("broken config", "config.json is damaged"),
        ("another config", "config.json: unknown key model.nonsense"),
    ],
)
def test_a_damaged_checkpoint_is_refused(run: Path, stage: str, fault: str, message: str) -> None:
    folder = run / stage / "checkpoint"
    file = folder / "weights.safetensors"
    if fault == "truncated":
        file.write_bytes(file.read_bytes()[:-100])
    elif fault == "missing tensors":
        tensors = load_tensors(file)
        del tensors[sorted(tensors)[0]]
        save_tensors(file, tensors)
    elif fault == "no weights":
        file.unlink()
    elif fault == "no meta":
        (folder / "meta.json").unlink()
    elif fault == "another config":
        config = json.loads((folder / "config.json").read_text())
        config["model"]["nonsense"] = 1
        (folder / "config.json").write_text(json.dumps(config))
    else:
        name = "meta.json" if fault == "broken meta" else "config.json"
        (folder / name).write_text((folder / name).read_text()[:40])
    before = contents(run)
    refused("evaluate", f"run={run}", message=message.format(stage=stage))
    assert contents(run) == before


@pytest.mark.parametrize("text", ["", "{}", '{"preset": "smoke", "sed": 1}'])
def test_a_damaged_run_config_is_refused(run: Path, text: str) -> None:
    (run / "config.json").write_text(text)
    before = contents(run)
    if text != "{}":
        refused("evaluate", f"run={run}", message="config.json cannot be used: .*; restore it or", code=2)
    refused("train-slots", f"out={run}", message="holds something else")
    assert contents(run) == before


def test_a_missing_parent_stage_names_its_command(slots_only: Path, tmp_path: Path) -> None:
    before = contents(slots_only)
    refused("train-policy", f"run={slots_only}", message="no dynamics checkpoint at .*: run `playslot train-dynamics`")
    refused("evaluate", f"run={slots_only}", message="got no policy/checkpoint, expected a trained policy")
    assert contents(slots_only) == before
    refused("train-dynamics", f"out={tmp_path / 'new'}", message="no such folder, expected a run folder")
    assert not (tmp_path / "new").exists()


# --- the machine --------------------------------------------------------------------------------------------------


def test_no_gl_backend_is_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "playslot_rl", "collect", "preset=smoke", "out=data", "workers=1"],
        env=os.environ | {"MUJOCO_GL": "bogus"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert_one_line(done.stderr, "collect")
    assert "MUJOCO_GL" in done.stderr
    assert not (tmp_path / "data").exists()


def test_a_nan_loss_stops_and_the_last_good_checkpoint_carries_on(
    shared_run: Path, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, original = tmp_path / "run", SlotsStage.loss

    def poisoned(self: SlotsStage, step: int, generators: object) -> dict[str, object]:
        losses = dict(original(self, step, generators))  # type: ignore[arg-type]
        return losses | ({"loss": losses["loss"] * float("nan")} if step == 4 else {})

    with monkeypatch.context() as patch:
        patch.setattr(SlotsStage, "loss", poisoned)
        message = "slots: loss is nan at step 5, expected a finite number; the last good checkpoint is .*step_00000003"
        refused("train-slots", f"out={run}", f"data.root={videos}", message=message)
    assert not (run / "slots" / "checkpoint").exists()
    smoke("train-slots", f"out={run}", f"data.root={videos}")
    assert weights(run, "slots") == weights(shared_run, "slots")


@pytest.mark.parametrize("rate", ["1e30", "1e39"])
def test_a_learning_rate_that_diverges_leaves_no_bad_checkpoint(videos: Path, tmp_path: Path, rate: str) -> None:
    changes = (f"slots.optim.lr={rate}", "slots.optim.grad_clip=0", "slots.optim.warmup_steps=0")
    refused("train-slots", f"out={tmp_path}/run", f"data.root={videos}", *changes, "slots.checkpoint_every=1",
            "slots.validate_every=1", message="slots: .* at step [12], expected a finite .*optim.lr")  # fmt: skip
    for file in (tmp_path / "run").rglob("modules.safetensors"):
        assert all(bool(tensor.isfinite().all()) for tensor in load_tensors(file).values())


@pytest.mark.parametrize("writes", [1, 4, 9, 14])
def test_a_full_disk_is_one_line_and_the_same_command_carries_on(
    shared_run: Path, videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    run, fsync, left = tmp_path / "run", os.fsync, [writes]

    def full(handle: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        refused("train-slots", f"out={run}", f"data.root={videos}", message="disk is full, expected .*free")
    assert not [path for path in run.rglob("*") if ".tmp-" in path.name]
    smoke("train-slots", f"out={run}", f"data.root={videos}")
    assert weights(run, "slots") == weights(shared_run, "slots")


# --- output folders -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["collect", "train-slots", "train-dynamics", "train-policy", "pipeline", "demo"])
@pytest.mark.parametrize("what", ["notes", "config of another tool", "data set", "file"])
def test_a_folder_that_holds_something_else_is_left_alone(
    command: str, what: str, foreign: Path, demos: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mine"
    if what == "data set":
        shutil.copytree(foreign, out)
    elif what == "file":
        out.write_text("mine")
    else:
        out.mkdir()
        (out / ("notes.txt" if what == "notes" else "config.json")).write_text("{}")
    before = contents(tmp_path)
    refused(command, f"out={out}", f"data.root={demos}", message="something else|got a file, expected a folder")
    assert contents(tmp_path) == before
