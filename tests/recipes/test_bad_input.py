"""Damaged runs and a machine that fails: one line, a non-zero exit, nothing lost, nothing half-written."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import assert_one_line, contents, refused, smoke, weights

from playslot_rl.storage.tensors import load_tensors, save_tensors

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(
    ("stage", "fault", "message"),
    [
        ("slots", "truncated", "was changed or damaged|is damaged"),
        ("policy", "missing tensors", "misses tensor|was changed or damaged"),
        ("dynamics", "no weights", "weights.safetensors is missing"),
        ("slots", "no meta", "no slots checkpoint at"),
        ("policy", "no meta", "got no policy/checkpoint"),
        ("dynamics", "broken meta", "meta.json is damaged|meta.json: got"),
        ("policy", "broken config", "config.json is damaged"),
        ("slots", "another config", "config.json: unknown key model.nonsense"),
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
    refused("evaluate", f"run={run}", message=message)
    assert contents(run) == before


@pytest.mark.parametrize("text", ["", "{}", '{"preset": "smoke", "sed": 1}'])
def test_a_damaged_run_config_is_refused(run: Path, text: str) -> None:
    (run / "config.json").write_text(text)
    before = contents(run)
    if text != "{}":
        refused("evaluate", f"run={run}", message="config.json cannot be used: .*; restore it or", code=2)
    refused("train-slots", f"out={run}", message="holds something else")
    assert contents(run) == before


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
