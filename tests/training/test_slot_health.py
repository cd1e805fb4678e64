"""Stage 1 looks at its slots while it trains: numbers, warnings with cures, pictures; and learns the same."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny_savi import tiny_savi

from playslot_rl.config import LoggingConfig, OptimConfig, SAViConfig, SlotsStageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.modules.savi import SAVi
from playslot_rl.seeds.draws import step_generator
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.logging import History
from playslot_rl.training.slot_warnings import slot_warnings
from playslot_rl.training.stage import Stage, WatchedStage
from playslot_rl.training.stage_slots import SlotsStage

HEALTHY = {"slots_in_use": 4.0, "flicker": 0.0, "mask_entropy": 0.4, "moving_explained": 0.8}
LONG = SlotsStageConfig(steps=6000)
BLOCKS = SAViConfig(decoder="pixel_shuffle", decoder_position="learned", transition_start="identity")


def videos() -> EpisodeFrames:
    frames = np.zeros((20, 32, 32, 3), np.uint8)
    for t in range(20):
        frames[t, 8:16, t : t + 8] = 200
    starts, lengths = np.arange(0, 20, 5, dtype=np.int64), np.full(4, 5, np.int64)
    return EpisodeFrames(frames, starts, lengths, None, None, "f", 10.0, "", "camera")


def stage(steps: int = 4, segmented: Callable[[SAVi], Mapping[str, float]] | None = None) -> SlotsStage:
    config = SlotsStageConfig(
        steps=steps, batch_size=2, clip_frames=4, validate_every=2, checkpoint_every=4, optim=OptimConfig(lr=1e-3)
    )
    return SlotsStage(tiny_savi(), Clips(videos(), 4, 0.25, 0), config, segmented)


class Blind:
    """The same stage with the validation it had before: the error alone, from the loss module."""

    def __init__(self, seeing: SlotsStage) -> None:
        self.seeing, self.modules, self.batch, self.loss = seeing, seeing.modules, seeing.batch, seeing.loss

    def validate(self, step: int) -> dict[str, float]:
        self.seeing.savi.precision = "fp32"
        errors = []
        for rows in self.seeing.clips.validation_batches():
            clips = TensorDict({"pixels": self.seeing.clips.pixels(rows, self.seeing.device)})
            generator = step_generator(0, step, "validation")
            errors.append(float(self.seeing.criterion(clips, generator)["loss_reconstruction"]))
        return {"mse": float(np.mean(errors))}


def train(stage: Stage, config: SlotsStageConfig, folder: Path, backend: Any = "none") -> None:
    fit(Part("slots", stage, config), folder, seed=3, logging=LoggingConfig(backend=backend, progress=False))


def test_looking_changes_neither_weights_nor_the_error(tmp_path: Path) -> None:
    seeing, other = stage(segmented=lambda _: {"foreground_ari": 0.4, "slots_per_object": 2.0}), stage()
    blind = Blind(other)
    assert isinstance(seeing, WatchedStage)
    assert not isinstance(blind, WatchedStage)
    train(seeing, seeing.config, tmp_path / "seeing", "tensorboard")
    train(blind, seeing.config, tmp_path / "blind")
    for (name, one), two in zip(seeing.savi.state_dict().items(), other.savi.state_dict().values(), strict=True):
        assert torch.equal(one, two), name
    rows = [
        [row["mse"] for row in History(tmp_path / name / "metrics.jsonl").read() if row["split"] == "validation"]
        for name in ("seeing", "blind")
    ]
    assert rows[0] == rows[1]
    assert len(rows[0]) == 2
    last = History(tmp_path / "seeing" / "metrics.jsonl").read()[-1]
    assert (last["foreground_ari"], last["slots_per_object"]) == (0.4, 2.0)


def test_validations_log_health_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    seeing = stage()
    train(seeing, seeing.config, tmp_path, "tensorboard")
    last = History(tmp_path / "metrics.jsonl").read()[-1]
    assert {"slots_in_use", "largest_slot", "flicker", "mask_entropy", "moving_explained"} <= last.keys()
    assert 0 <= last["mask_entropy"] <= math.log(3) + 1e-6
    events = EventAccumulator(str(tmp_path / "logs"))
    events.Reload()
    assert "slots/validation/flicker" in events.Tags()["scalars"]
    pictures = events.Images("slots/validation/slots")
    assert [(p.step, p.width, p.height) for p in pictures] == [(2, 4 * 32, 3 * 32), (4, 4 * 32, 3 * 32)]
    # Five frames of nothing learned: what is wrong is said once, not at every validation.
    said = capsys.readouterr().out
    assert said.count("what moves is hardly drawn") == 1
    assert "slots: warning at step 2" in said


def test_a_warning_is_said_when_it_comes_up_and_again_once_it_had_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = iter([{"a": "first"}, {"a": "first", "b": "second"}, {}, {"a": "first"}])
    seeing = stage(8)
    monkeypatch.setattr(SlotsStage, "warnings", lambda *_: next(kinds))
    train(seeing, seeing.config, tmp_path)
    said = [line.removeprefix("slots: warning at ") for line in capsys.readouterr().out.splitlines()]
    assert said == ["step 2: first", "step 4: second", "step 8: first"]


def test_healthy_slots_are_not_warned_of() -> None:
    assert slot_warnings(HEALTHY, SAViConfig(), LONG) == {}
    assert slot_warnings({}, SAViConfig(), LONG) == {}
    assert slot_warnings({"slots_in_use": 1.0}, SAViConfig(n_slots=1), LONG) == {}


@pytest.mark.parametrize(
    ("kind", "sick", "text", "cure"),
    [
        ("single", {"slots_in_use": 1.0}, "one slot holds everything (1.0 of 4", "model.savi.slot_dim"),
        (
            "split",
            {"slots_per_object": 2.0, "foreground_ari": 0.54},
            "objects are spread over several slots (2.0 each, FG-ARI 0.54)",
            "model.savi.slot_dim",
        ),
        ("flicker", {"flicker": 0.6}, "slots change places (0.60", "model.savi.transition_start=identity"),
        ("shared", {"mask_entropy": math.log(4)}, "all slots share all pixels", "slots.start_from="),
        (
            "unseen",
            {"moving_explained": 0.1},
            "what moves is hardly drawn (10 %",
            "model.savi.decoder_position=learned",
        ),
    ],
)
def test_each_sickness_is_named_with_its_cure(kind: str, sick: dict[str, float], text: str, cure: str) -> None:
    found = slot_warnings(HEALTHY | sick, SAViConfig(decoder="pixel_shuffle"), LONG)
    assert list(found) == [kind]
    assert text in found[kind]
    assert cure in found[kind]
    assert "\n" not in found[kind]


def test_a_cure_in_use_is_not_named_again() -> None:
    found = slot_warnings(HEALTHY | {"flicker": 1.0, "moving_explained": 0.0}, BLOCKS, LONG)
    assert set(found) == {"flicker", "unseen"}
    assert "identity" not in found["flicker"]
    assert "decoder_position" not in found["unseen"]
    assert "slots.zoom_steps=1500" in found["unseen"]
    assert "slots.foreground_weight=30" in found["unseen"]
    used = replace(LONG, zoom_steps=1500, start_from="pretrained/block_push_easy")
    for weighed in (replace(used, motion_weight=30.0), replace(used, foreground_weight=30.0)):
        left = slot_warnings(HEALTHY | {"moving_explained": 0.0}, SAViConfig(decoder="pixel_shuffle"), weighed)
        assert left["unseen"].endswith(
            "explained): train for longer than 6000 steps (slots.steps=, or minutes= of adopt)"
        )


@pytest.mark.parametrize(
    "sick", [{"mask_entropy": math.log(4)}, {"slots_in_use": 1.0}, {"slots_per_object": 2.0}, {"moving_explained": 0.0}]
)
def test_cures_fit_into_the_stage_and_its_settings(sick: dict[str, float]) -> None:
    """142 steps have no room for 1,500 magnified ones, and a stage that starts from another none for new sizes."""
    short = SlotsStageConfig(steps=142, start_from="pretrained/block_push_easy")
    (said,) = slot_warnings(HEALTHY | sick, SAViConfig(decoder="pixel_shuffle"), short).values()
    assert "train for longer than 142 steps" in said
    for other in ("zoom_steps", "start_from", "slot_dim", "decoder_position"):
        assert other not in said


def test_the_first_quarter_is_not_warned_of() -> None:
    seeing = stage(8)
    assert seeing.warnings(1, {"slots_in_use": 1.0}) == {}
    assert list(seeing.warnings(2, {"slots_in_use": 1.0})) == ["single"]
