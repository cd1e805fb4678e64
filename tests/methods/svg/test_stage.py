"""SVG's training: what a step draws, learning."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from clips import moving_square

from playslot_rl.data.clips import Clips
from playslot_rl.frames import normalise
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.model import SVG
from playslot_rl.methods.svg.training import SVGStage
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage import step_loss


def make_stage(config: SVGConfig, episodes: int = 6) -> SVGStage:
    """Of clips of 32 pixels, so of one level more than the other tests have."""
    torch.manual_seed(0)
    config = replace(config, channels=(*config.channels, 8), convs=(*config.convs, 1))
    frames = config.seed_frames + config.predicted_frames
    clips = Clips(moving_square(episodes, length=8, size=32), frames, validation=0.3, seed=0)
    return SVGStage(SVG(config, 32), clips, config)


def test_a_steps_randomness_is_all_from_its_generators(config: SVGConfig) -> None:
    stage = make_stage(replace(config, decoded_frames=2))
    losses = []
    for seed, step in ((0, 1), (0, 1), (0, 2), (1, 1)):
        torch.manual_seed(len(losses))
        losses.append(step_loss(stage, step, StepGenerators(seed, step))["loss"].item())
    assert losses[0] == losses[1]
    assert len(set(losses)) == 3


def test_the_latents_of_a_step_are_sampled(config: SVGConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = make_stage(config)
    with torch.no_grad():
        for parameter in stage.model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(std=0.3)
    rows = stage.clips.held_out[:2]
    monkeypatch.setattr(stage.clips, "sample", lambda batch, generator: rows)
    with torch.no_grad():
        one, two = (float(step_loss(stage, 0, StepGenerators(seed, 0))["loss"]) for seed in (0, 1))
    assert one != two


def test_only_the_asked_frames_are_decoded(config: SVGConfig) -> None:
    decoded: list[int] = []
    for count in (0, 2):
        stage = make_stage(replace(config, decoded_frames=count))
        stage.model.decoder.register_forward_hook(lambda module, inputs, output: decoded.append(len(output)))
        step_loss(stage, 0, StepGenerators(0, 0))
    assert decoded == [3 * 5, 3 * 2]


@pytest.mark.integration
def test_training_predicts_better_with_running_statistics_too(config: SVGConfig) -> None:
    stage = make_stage(replace(config, batch_size=4, decoded_frames=3, channels=(8, 8)), episodes=12)
    optimizer = torch.optim.Adam(stage.model.parameters(), lr=5e-3)

    def validate() -> float:
        stage.model.eval()
        with torch.no_grad():
            return stage.validate(0)["mse"]

    values, before = [], validate()
    for step in range(30):
        stage.model.train()
        optimizer.zero_grad()
        terms = step_loss(stage, step, StepGenerators(0, step))
        terms["loss"].backward()
        optimizer.step()
        values.append(terms["loss_image"].item())
    assert sum(values[-5:]) < 0.25 * sum(values[:5])
    assert validate() < 0.25 * before


def test_validation_clamps_scores_frames_and_then_averages(config: SVGConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = make_stage(config)
    stage.model.eval()

    def predict(frames: torch.Tensor, seed: int) -> torch.Tensor:
        predicted = frames[:, seed:].clone()
        predicted[:, 0] += 0.1
        predicted[:, 1] = 3.0
        return predicted

    monkeypatch.setattr(stage.model, "predict", predict)
    with torch.no_grad():
        metrics = stage.validate(0)
    assert metrics.keys() == {"psnr", "mse", "psnr_prior", "kl"}
    white = (1 - normalise(stage.clips.source.pixels(stage.clips.held_out))[:, 4]).square().mean(dim=(1, 2, 3))
    assert metrics["mse"] == pytest.approx((0.01 + float(white.mean()) + 0) / 3, rel=1e-4)
    assert metrics["psnr"] == pytest.approx((20 + float((-10 * white.log10()).mean()) + 80) / 3, rel=1e-4)
    assert metrics["kl"] > 0


def test_validation_gives_the_same_numbers_twice_and_leaves_the_model_as_it_is(config: SVGConfig) -> None:
    stage = make_stage(config)
    stage.model.eval()
    before = {key: value.clone() for key, value in stage.model.state_dict().items()}
    with torch.no_grad():
        assert stage.validate(1) == stage.validate(2)
    assert all(torch.equal(value, before[key]) for key, value in stage.model.state_dict().items())


def test_half_precision_trains_on_about_the_same_loss(config: SVGConfig) -> None:
    losses = []
    for precision in ("fp32", "bf16"):
        stage = make_stage(replace(config, precision=precision))
        loss = step_loss(stage, 0, StepGenerators(0, 0))["loss"]
        loss.backward()
        assert loss.dtype == torch.float32
        losses.append(loss.item())
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
