"""LAPO's mathematics: what each network sees, where gradients go, what the stage learns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import moving_square

from playslot_rl import keys
from playslot_rl.acting.actor import latent_actor
from playslot_rl.config import ActionDecoderConfig, BehaviourStageConfig, OptimConfig, StageConfig
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import transitions
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.lapo.method import LAPOConfig
from playslot_rl.methods.lapo.model import ForwardModel, InverseModel, LAPOPolicy
from playslot_rl.methods.lapo.training import LAPOModelStage, infer_latents
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_behaviour import JointStage
from playslot_rl.training.stage_regression import FrameInputs, RegressionStage, TakenInputs

CONFIG = LAPOConfig(channels=(8, 16), hidden=32, groups=2, code_dim=4, codes=4)


@pytest.fixture
def models() -> tuple[InverseModel, ForwardModel]:
    torch.manual_seed(0)
    return InverseModel(CONFIG, 32), ForwardModel(CONFIG)


def test_a_latent_action_is_made_of_codes(models: tuple[InverseModel, ForwardModel]) -> None:
    inverse, _ = models
    inferred = inverse(torch.rand(6, 3, 32, 32), torch.rand(6, 3, 32, 32))
    assert inferred.z.shape == (6, 8)
    assert inferred.code.shape == (6, 2)
    inverse.eval()
    inferred = inverse(torch.rand(6, 3, 32, 32), torch.rand(6, 3, 32, 32))
    codes = inverse.quantizer.prototypes[inferred.code].flatten(1)
    torch.testing.assert_close(inferred.z, codes, atol=1e-5, rtol=0)


def test_the_codebook_moves_in_training_only(models: tuple[InverseModel, ForwardModel]) -> None:
    inverse, _ = models
    frames = torch.rand(2, 6, 3, 32, 32)
    inverse(*frames)
    before = inverse.quantizer.prototypes.clone()
    inverse.eval()(*frames)
    assert torch.equal(inverse.quantizer.prototypes, before)
    inverse.train()(*(frames * 0.5))
    assert not torch.equal(inverse.quantizer.prototypes, before)


def test_the_forward_model_starts_from_no_change(models: tuple[InverseModel, ForwardModel]) -> None:
    _, forward = models
    frame = torch.rand(2, 3, 32, 32)
    assert torch.equal(forward(frame, torch.randn(2, 8)), frame)


def test_the_image_error_trains_the_inverse_model_through_the_latent(
    models: tuple[InverseModel, ForwardModel],
) -> None:
    inverse, forward = models
    with torch.no_grad():
        for weights in forward.ups[-1].parameters():
            weights.normal_(std=0.1)
    first, second = torch.rand(4, 3, 32, 32), torch.rand(4, 3, 32, 32)
    inferred = inverse(first, second)
    (forward(first, inferred.z) - second).square().mean().backward()
    grads = [p.grad for p in inverse.network.parameters()]
    assert all(grad is not None for grad in grads)
    assert any(bool(grad.abs().sum() > 0) for grad in grads if grad is not None)


@pytest.mark.integration
def test_training_predicts_the_change_and_the_codes_tell_directions_apart(
    models: tuple[InverseModel, ForwardModel],
) -> None:
    inverse, forward = models
    source = moving_square(episodes=24)
    config = StageConfig(steps=200, batch_size=16, optim=OptimConfig(lr=3e-3))
    stage = LAPOModelStage(inverse, forward, Clips(source, 2, validation=0.2, seed=0, shown=256), config)
    optimizer = torch.optim.Adam([*inverse.parameters(), *forward.parameters()], lr=3e-3)
    with torch.no_grad():
        start = step_loss(stage, 0, StepGenerators(0, 0))["loss_image"]
    assert 0.5 < float(start) < 2, "before training the error is that of no change"
    for step in range(config.steps):
        # Falling to 0: at a constant rate the last steps' noise, another on each processor, decided.
        optimizer.param_groups[0]["lr"] = 3e-3 * (1 - step / config.steps)
        optimizer.zero_grad()
        with global_seed(0, step):
            step_loss(stage, step, StepGenerators(0, step))["loss"].backward()
        optimizer.step()
    inverse.eval(), forward.eval()
    with torch.no_grad():
        assert stage.validate(config.steps)["unexplained"] < 0.6
    moves = transitions(source)
    assert source.actions is not None
    frames = source.pixels(np.stack((moves.rows, moves.rows + 1), axis=1))
    directions: dict[tuple[int, ...], list[bool]] = {}
    for code, action in zip(
        inverse(frames[:, 0], frames[:, 1]).code.tolist(), source.actions[moves.rows, 0], strict=True
    ):
        directions.setdefault(tuple(code), []).append(bool(action > 0))
    told = sum(max(sum(group), len(group) - sum(group)) for group in directions.values())
    assert len(directions) <= 8, "few enough for a majority to mean something"
    assert told / len(moves.rows) > 0.9


def test_latents_of_transitions_are_in_the_order_of_their_rows(models: tuple[InverseModel, ForwardModel]) -> None:
    inverse, source = models[0].eval(), moving_square()
    moves = transitions(source)
    latents = infer_latents(inverse, source, moves)
    assert latents.shape == (len(moves.rows), 8)
    frames = source.pixels(np.array([moves.rows[7], moves.rows[7] + 1]))
    inferred = inverse(frames[:1], frames[1:])
    torch.testing.assert_close(latents[7:8], inferred.z, atol=1e-5, rtol=0)
    before = infer_latents(inverse, source, moves, quantised=False)  # baselines.lapo.targets=continuous
    torch.testing.assert_close(before[7:8], inferred.before, atol=1e-5, rtol=0)
    assert not torch.allclose(before, latents)


def test_the_actor_decodes_the_policys_latent_and_what_it_saw() -> None:
    torch.manual_seed(0)
    config = replace(CONFIG, channels=(4, 4))
    sizes = ActionDecoderConfig(8, state_dim=8, state_layers=1, state_heads=2)
    pixels = torch.randint(256, (3, 3, 32, 32), dtype=torch.uint8)
    for reads in (False, True):
        policy = LAPOPolicy(config, 32)
        decoder = ActionDecoder(replace(sizes, reads_slots=reads), config.latent_dim, 4, config.hidden).eval()
        actor = latent_actor(policy, decoder)
        out = actor(actor.reset([1, 2, 3]).set(keys.PIXELS, pixels))
        seen = policy.features(pixels.float() / 255)
        assert seen.shape == (3, 1, config.hidden)
        torch.testing.assert_close(out[keys.ACTION], decoder(policy(pixels.float() / 255), seen if reads else None))
        if reads:
            assert not torch.allclose(out[keys.ACTION], decoder(policy(pixels)))


def test_fine_tuning_shows_labelled_rows_their_actions_and_goes_on_cloning_all() -> None:
    torch.manual_seed(0)
    source = moving_square()
    moves = transitions(source)
    frames, labelled = FrameInputs(source, moves.rows, "cpu"), torch.tensor([3, 8, 9])
    policy, decoder = LAPOPolicy(CONFIG, 32), ActionDecoder(ActionDecoderConfig(8), CONFIG.latent_dim, 2, CONFIG.hidden)
    criterion = BehaviourLoss(policy)
    criterion.set_keys(observation=keys.PIXELS)
    clone = RegressionStage("policy", criterion, frames, torch.randn(len(moves.rows), CONFIG.latent_dim), 64)
    shown = TakenInputs(frames, labelled), torch.randn(3, 2)
    stage = JointStage(clone, decoder, shown, None, BehaviourStageConfig(batch_size=64))
    batch = stage.batch(0, StepGenerators(0, 0))
    acted = {tuple(frame.flatten().tolist()) for frame in batch["acting/pixels"]}
    assert acted == {tuple(frame.flatten().tolist()) for frame in source.pixels(moves.rows[labelled.numpy()])}
    assert len(batch["cloning/pixels"].flatten(1).unique(dim=0)) > 3
    stage.loss(batch, 0, StepGenerators(0, 0))["action"].backward()
    for network in (policy.network.encoder, decoder):
        assert any(bool(p.grad.abs().sum() > 0) for p in network.parameters() if p.grad is not None)
