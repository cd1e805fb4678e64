"""Training on sets with weights, and on frames that are decoded while they are read."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import ONE_CORE, killed_at_first_checkpoint, playslot, refused, smoke, weights

pytestmark = pytest.mark.integration

STEPS = ("slots.steps=12", "slots.checkpoint_every=4", "slots.validate_every=6")


def test_both_stages_learn_from_sets_with_weights(videos: Path, demos: Path, tmp_path: Path) -> None:
    roots = f"data.root={videos}:3,{demos}:1"
    smoke("train-slots", f"out={tmp_path}", roots, "slots.steps=2", f"data.cache={tmp_path / 'cache'}")
    smoke("train-dynamics", f"run={tmp_path}", roots, "dynamics.steps=2", "dynamics.from_start=0.5")
    metas = [json.loads((tmp_path / stage / "checkpoint/meta.json").read_text()) for stage in ("slots", "dynamics")]
    assert metas[0]["data"] == metas[1]["data"]
    refused(
        "train-slots", f"out={tmp_path}", f"data.root={videos},{demos}", "slots.steps=2", message="was trained with"
    )
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["data"]["root"] == f"{videos}:3,{demos}:1"


@pytest.mark.slow
def test_a_streamed_training_ends_as_before_after_a_kill(videos: Path, tmp_path: Path) -> None:
    data = (f"data.root={videos}", f"data.cache={tmp_path / 'cache'}", "data.stream=true", "data.shuffle_buffer=4")
    smoke("train-slots", *data, *STEPS, f"out={tmp_path / 'whole'}")
    assert not (tmp_path / "cache" / "frames").exists()
    command = ("train-slots", "preset=smoke", *data, *STEPS, f"out={tmp_path / 'killed'}")
    killed_at_first_checkpoint(tmp_path / "killed" / "slots", *command, *ONE_CORE)
    assert playslot(*command, *ONE_CORE).code == 0
    assert weights(tmp_path / "killed", "slots") == weights(tmp_path / "whole", "slots")


def test_another_buffer_is_another_training(videos: Path, tmp_path: Path) -> None:
    data = (f"data.root={videos}", "data.stream=true", f"out={tmp_path}")
    smoke("train-slots", *data, *STEPS, "data.shuffle_buffer=4")
    shutil.rmtree(tmp_path / "slots" / "checkpoint")
    refused("train-slots", *data, *STEPS, "data.shuffle_buffer=8", message=r"shuffle_buffer")
