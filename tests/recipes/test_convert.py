"""`playslot convert`: Sketchy's layout in, two LeRobot data sets out, which train and are compared on."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import ONE_CORE, playslot, refused
from sketchy_layout import name_of, write_sketchy

pytestmark = pytest.mark.integration


@pytest.mark.usefixtures("started")
def test_a_converted_data_set_trains_and_compares_on_both_cameras(tmp_path: Path) -> None:
    source, out = write_sketchy(tmp_path / "download"), tmp_path / "set"
    done = playslot("convert", "env=sketchy", f"data.root={source}", f"out={out}", *ONE_CORE)
    assert (done.code, done.err) == (0, "")
    assert "train (4 episodes)" in done.out
    assert "eval (1 episodes)" in done.out
    cameras = "data.camera=observation.images.front_left,observation.images.front_right"
    train = ("env=sketchy", "preset=smoke", f"data.root={out / 'train'}", cameras, f"out={tmp_path / 'run'}")
    done = playslot("train-slots", *train, "slots.steps=2", "model.savi.n_slots=3", *ONE_CORE)
    assert done.code == 0, done.err
    refused("convert", "env=sketchy", f"data.root={source}", f"out={out}", message="choose another out=")
    done = playslot(
        "compare-video", *train[:-1], f"compare_video.test={out / 'eval'}", f"run={tmp_path / 'run'}",
        "methods=slotformer", "compare_video.predicted=2", "compare_video.rates=[1.0]", f"out={tmp_path / 'video'}",
        "model.savi.n_slots=3", *ONE_CORE,
    )  # fmt: skip
    assert done.code == 0, done.err
    assert "| SlotFormer |" in (tmp_path / "video" / "video.md").read_text()


def test_what_cannot_be_converted_is_one_line(tmp_path: Path) -> None:
    source, out = write_sketchy(tmp_path / "download"), f"out={tmp_path / 'set'}"
    refused(
        "convert", "env=sketchy", f"data.root={source}", "data.camera=top", out, message="expected some of front_left"
    )
    (source / "episodes" / name_of(0)).unlink()
    refused("convert", "env=sketchy", f"data.root={source}", out, message="no file for 1 of 5 episodes")
    assert [path.name for path in tmp_path.iterdir()] == ["download"]
