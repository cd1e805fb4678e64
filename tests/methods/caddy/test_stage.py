"""CADDY's stage: schedules, resuming across the end of the warm-up, and that it learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from caddy_parts import tiny, tiny_config
from clips import moving_square

from playslot_rl.data.clips import Clips
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.stage import CADDYStage, clip_length, load_perceptual, temperature
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.tensors import load_tensors
from playslot_rl.training.fit import Part, fit
from playslot_rl.training.logging import History
from playslot_rl.training.stage import step_loss

FIT = {
    "seed_frames": 1,
    "predicted_frames": 2,
    "first_frames": 2,
    "steps": 6,
    "batch_size": 3,
    "warmup_steps": 3,
    "anneal_steps": 4,
    "growth_steps": 5,
    "decoded_frames": 1,
    "checkpoint_every": 2,
    "validate_every": 3,
    "log_every": 1,
}


def stage_of(**changes: object) -> CADDYStage:
    config = tiny_config(**changes)
    frames = config.seed_frames + config.predicted_frames
    square = moving_square(episodes=6, length=frames, size=32)
    small = replace(square, frames=square.frames[:, ::2, ::2])
    clips = Clips(small, frames, validation=0.3, seed=0, shown=4)
    with global_seed(0, 0, "tests"):
        return CADDYStage(tiny(**changes), clips, config)


def test_the_temperature_falls_linearly_and_then_stays() -> None:
    config = CADDYConfig(temperature=(1.0, 0.4), anneal_steps=100)
    got = [temperature(config, step) for step in (0, 50, 100, 1000)]
    assert got == pytest.approx([1.0, 0.7, 0.4, 0.4])


def test_clips_grow_linearly_to_their_full_length() -> None:
    config = CADDYConfig(seed_frames=6, predicted_frames=8, first_frames=7, growth_steps=70)
    assert [clip_length(config, step) for step in (0, 9, 10, 69, 70, 1000)] == [7, 7, 8, 13, 14, 14]
    assert clip_length(CADDYConfig(growth_steps=0), 0) == 14
    assert clip_length(CADDYConfig(seed_frames=1, predicted_frames=1, first_frames=7), 0) == 2


def test_the_warm_up_ends_at_its_step() -> None:
    stage = stage_of(warmup_steps=2, batch_size=2)
    fitted = ["loss_fit" in step_loss(stage, step, StepGenerators(0, step)) for step in range(4)]
    assert fitted == [True, True, False, False]


def test_decoded_frames_are_drawn_anew_each_step_and_are_as_many_as_said() -> None:
    stage = stage_of(decoded_frames=2)
    drawn = [stage._wanted(5, StepGenerators(0, step)) for step in range(40)]
    assert all(times is not None and len(set(times)) == 2 for times in drawn)
    assert {time for times in drawn if times is not None for time in times} == {1, 2, 3, 4}
    assert stage._wanted(5, StepGenerators(0, 7)) == drawn[7]
    assert stage._wanted(3, StepGenerators(0, 0)) is None, "a short clip is decoded whole"


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    last = folder / "checkpoints" / f"step_{FIT['steps']:08d}"
    return load_tensors(last / "modules.safetensors") | load_tensors(last / "optimizer.safetensors")


def train(folder: Path) -> int:
    stage = stage_of(**FIT)
    return fit(Part("baselines.caddy", stage, stage.config), folder, seed=3)[1]


@pytest.mark.integration
def test_a_resumed_run_repeats_bit_for_bit_across_the_end_of_the_warm_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tmp_path / "whole")
    original = CADDYStage.batch
    for step, kept in ((3, 2), (5, 4)):

        def batch(self: CADDYStage, number: int, generators: StepGenerators, stop: int = step) -> object:
            if number == stop:
                raise KeyboardInterrupt
            return original(self, number, generators)

        with monkeypatch.context() as patch:
            patch.setattr(CADDYStage, "batch", batch)
            with pytest.raises(KeyboardInterrupt, match=f"carries on from step {kept} "):
                train(tmp_path / "parts")
    assert train(tmp_path / "parts") == 4
    one, other = tensors(tmp_path / "whole"), tensors(tmp_path / "parts")
    assert one.keys() == other.keys()
    assert [key for key in one if not torch.equal(one[key], other[key])] == []
    rows = [History(tmp_path / name / "metrics.jsonl").read() for name in ("whole", "parts")]
    for row in rows[0] + rows[1]:
        del row["seconds"]
    assert rows[0] == rows[1]


@pytest.mark.integration
def test_training_lowers_the_loss_and_the_held_out_error() -> None:
    stage = stage_of(seed_frames=1, predicted_frames=2, warmup_steps=10, growth_steps=0, batch_size=6)
    optimizer = torch.optim.Adam(stage.model.parameters(), lr=1e-2)
    stage.model.eval()
    with torch.no_grad():
        before = stage.validate(0)
    stage.model.train()
    losses = []
    for step in range(60):
        optimizer.zero_grad()
        parts = step_loss(stage, step, StepGenerators(0, step))
        parts["loss"].backward()
        optimizer.step()
        losses.append({key: value.item() for key, value in parts.items()})
    images = [row["loss_image"] for row in losses]
    assert sum(images[7:10]) < 0.8 * sum(images[:3]), "reconstructions"
    assert losses[9]["loss_fit"] < losses[0]["loss_fit"]
    assert sum(images[-3:]) < 0.8 * sum(images[10:13]), "predictions"
    stage.model.eval()
    with torch.no_grad():
        after = stage.validate(22)
    assert after["psnr"] > before["psnr"] + 1


def test_a_validation_says_what_the_actions_do() -> None:
    stage = stage_of()
    stage.model.eval()
    with torch.no_grad():
        values = stage.validate(0)
        frames = stage._frames(stage.clips.held_out)
        predicted = stage.model.predict(frames, 2)
    error = (predicted - frames[:, 2:]).square().mean(dim=(2, 3, 4))
    assert values["mse"] == pytest.approx(float(error.mean()), rel=1e-4)
    assert values["psnr"] == pytest.approx(float((-10 * (error + 1e-8).log10()).mean()), rel=1e-4)
    assert 0 < values["usage"] <= 1
    assert 1 <= values["perplexity"] <= 3 + 1e-5
    assert -1e-5 <= values["information"] <= 1.0987
    assert values["variability"] > 0


def test_bf16_gives_finite_losses_and_gradients() -> None:
    stage = stage_of(precision="bf16", batch_size=2)
    for step in (0, 2000):
        step_loss(stage, step, StepGenerators(0, step))["loss"].backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in stage.model.parameters())


def test_the_stage_says_whether_images_are_compared_by_more_than_l1(monkeypatch: pytest.MonkeyPatch) -> None:
    assert stage_of().objective.perceptual is None
    assert load_perceptual("") is None
    assert list(stage_of().modules) == ["caddy"]
