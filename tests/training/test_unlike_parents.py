"""A stage says where its frames are not like those that its parents were shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from clips import moving_square

from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import CheckpointError
from playslot_rl.methods.playslot.method import SLOTS
from playslot_rl.storage.resume import first_difference
from playslot_rl.training import record as records
from playslot_rl.training.record import StageRecord

STRIDE = "got 5 frames a second, expected 10 as the run's model was shown: record at that rate, or choose data.stride="


@pytest.mark.parametrize(
    ("fps", "camera", "parent", "expected"),
    [
        (10.0, "front", {"fps": 10.0, "camera": "front"}, []),
        (10.0, "front", {"fps": 10.0, "camera": "front,side"}, []),
        (10.0, "front", {}, []),
        (5.0, "front", {"fps": 10.0, "camera": "front"}, [STRIDE]),
        (10.0, "front,side", {"fps": 10.0, "camera": "front"}, ["got frames of front,side, expected front as"]),
        (5.0, "side", {"fps": 10.0, "camera": "front"}, [STRIDE, "got frames of side, expected front as"]),
    ],
)
def test_another_rate_or_camera_is_one_line(
    fps: float, camera: str, parent: dict[str, Any], expected: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    parents = cast("Any", {name: SimpleNamespace(meta=parent) for name in ("slots", "dynamics")})
    record = StageRecord(METHODS["playslot"].last, Path("run"), ExperimentConfig(demos=4), parents)
    name = f"{fps:g} {camera} {parent}"  # a line is said once
    vars(record)["videos"] = replace(moving_square(), fps=fps, camera=camera, name=name)
    record.say_unlike()
    said = capsys.readouterr().err.splitlines()
    for line, start in zip(said, expected, strict=True):
        assert line.startswith(f"note: {name}: {start}")


@pytest.mark.parametrize(
    ("camera", "stored", "skipped"),
    [
        ("front", "front", True),
        ("front", None, True),
        ("front,side", "front", True),  # versions before named the first
        ("side", "front", False),
        ("side,front", "front,side", False),
    ],
)
def test_a_stage_is_finished_with_the_camera_that_it_was_shown(
    camera: str, stored: str | None, skipped: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = replace(moving_square(), camera=camera)
    meta = {"data": {"train": source.fingerprint}, "steps": 1, "camera": stored, "fingerprint": "whole"}
    done = SimpleNamespace(meta=meta, config={}, fingerprint="whole")
    (tmp_path / "slots" / "checkpoint").mkdir(parents=True)
    (tmp_path / "slots" / "checkpoint" / "meta.json").touch()
    for name, value in (("read_stage", done), ("require_parents", None), ("require_config", None)):
        monkeypatch.setattr(records, name, lambda *_, value=value: value)
    record = StageRecord(SLOTS, tmp_path, ExperimentConfig(data=DataConfig(root="videos")))
    vars(record)["videos"] = source
    if skipped:
        assert record.finished() is cast("Any", done)
    else:
        with pytest.raises(CheckpointError, match=f"data.camera: got {camera}, expected front"):
            record.finished()


@pytest.mark.parametrize(
    ("camera", "stored", "resumed"),
    [("front", "front", True), ("front", None, True), ("side", "front", False), ("front,side", "front", False)],
)
def test_a_stage_that_was_begun_goes_on_with_its_camera_alone(
    camera: str, stored: str | None, resumed: bool, tmp_path: Path
) -> None:
    record = StageRecord(SLOTS, tmp_path, ExperimentConfig(data=DataConfig(root="videos")))
    vars(record)["videos"] = replace(moving_square(), camera=camera)
    begun = {key: value for key, value in record.resumes().items() if key != "data.camera"}
    if stored is not None:  # versions before did not say it
        begun["data.camera"] = stored
    found = first_difference(begun, record.resumes(), record.spec.typed)
    assert found == (None if resumed else ("data.camera", stored, camera))
