"""LAPO's mathematics: what each network sees, where gradients go, what the stage learns."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from clips import moving_square

from playslot_rl import keys
from playslot_rl.acting.actor import latent_actor
from playslot_rl.config import ActionDecoderConfig, BehaviourStageConfig, OptimConfig, StageConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import transitions
from playslot_rl.data.neighbours import Ends
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.losses.behaviour import BehaviourLoss
from playslot_rl.methods.cloning import inferred
from playslot_rl.methods.lapo.method import Encoder, LAPOConfig, Targets
from playslot_rl.methods.lapo.model import ConvEncoder, ForwardModel, InverseModel, LAPOPolicy, sizes
from playslot_rl.methods.lapo.training import LAPOModelStage, load_inverse
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeds.draws import StepGenerators, global_seed
from playslot_rl.storage.checkpoints import save_stage
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_behaviour import JointStage
from playslot_rl.training.stage_regression import FrameInputs, RegressionStage, TakenInputs

CONFIG = LAPOConfig(
    encoder="strided", channels=(8, 16), forward_channels=(8, 16), hidden=32, groups=2, code_dim=4, codes=4, decay=0.99
)


Models = tuple[InverseModel, ForwardModel]


@pytest.fixture
def models() -> Models:
    torch.manual_seed(0)
    return InverseModel(CONFIG, 32), ForwardModel(CONFIG)


def test_a_latent_action_is_made_of_codes_of_two_codebooks(models: Models) -> None:
    inverse, frames = models[0], torch.rand(6, 3, 3, 32, 32)
    alone = inverse(frames)
    assert alone.z.shape == (6, 8)
    assert alone.code.shape == (6, 2)
    alone = inverse.eval()(frames)
    books = [quantizer.prototypes for quantizer in inverse.quantizers]
    assert len(books) == 2
    codes = [book[alone.code[:, number]] for number, book in enumerate(books)]
    torch.testing.assert_close(alone.z, torch.cat(codes, dim=1), atol=1e-5, rtol=0)


def test_the_codebooks_move_in_training_only(models: Models) -> None:
    inverse, frames = models[0], torch.rand(6, 3, 3, 32, 32)
    inverse(frames)
    before = [quantizer.prototypes.clone() for quantizer in inverse.quantizers]
    inverse.eval()(frames)
    assert all(torch.equal(q.prototypes, old) for q, old in zip(inverse.quantizers, before, strict=True))
    inverse.train()(frames * 0.5)
    assert not any(torch.equal(q.prototypes, old) for q, old in zip(inverse.quantizers, before, strict=True))


def test_latents_are_standardised_in_evaluation_however_far_the_mean_has_moved(models: Models) -> None:
    inverse, frames = models[0], torch.rand(64, 3, 3, 32, 32)
    inverse(frames)
    with torch.no_grad():
        inverse.network.mlp[2].bias.add_(3.0)  # type: ignore[union-attr, operator, index]
    inverse.eval()
    assert bool((inverse(frames).before.mean(0) > 1).all())
    inverse.settle(frames.split(16))
    z = inverse(frames).before
    torch.testing.assert_close(z.mean(0), torch.zeros(8), atol=1e-3, rtol=0)
    torch.testing.assert_close(
        z.std(0), torch.ones(8), atol=0.2, rtol=0
    )  # BatchNorm's eps counts where frames differ little


def test_the_inverse_model_sees_three_frames_and_the_forward_model_the_first_two(models: Models) -> None:
    inverse, forward = models[0].eval(), models[1].eval()
    with torch.no_grad():
        for weights in forward.ups[-1].parameters():
            weights.normal_(std=0.1)
    frames, z = torch.rand(2, 3, 3, 32, 32), torch.randn(2, 8)
    for seen in range(3):
        other = frames.clone()
        other[:, seen] = 1 - other[:, seen]
        assert not torch.equal(inverse(other).before, inverse(frames).before)
        assert torch.equal(forward(other[:, :-1], z), forward(frames[:, :-1], z)) == (seen == 2)


def test_before_an_episodes_first_frame_it_stands_again() -> None:
    source = moving_square(length=3)
    moves = transitions(source)
    rows = Ends.of(source).past(moves.rows + 1, 3)
    assert rows[:4].tolist() == [[0, 0, 1], [0, 1, 2], [3, 3, 4], [3, 4, 5]]
    assert Ends.of(source).past(np.array([4]), 2).tolist() == [[3, 4]]


def test_the_forward_model_starts_from_no_change(models: Models) -> None:
    past = torch.rand(2, 2, 3, 32, 32)
    assert torch.equal(models[1](past, torch.randn(2, 8)), past[:, -1])


@pytest.mark.parametrize("place", ["to_input", "to_map"])
def test_the_latent_enters_at_the_input_and_at_the_lowest_resolution(models: Models, place: str) -> None:
    forward = models[1].eval()
    for name in ("to_input", "to_map"):
        if name != place:
            torch.nn.init.zeros_(getattr(forward, name).weight)
    with torch.no_grad():
        for weights in forward.ups[-1].parameters():
            weights.normal_(std=0.1)
    past = torch.rand(1, 2, 3, 32, 32)
    assert not torch.allclose(forward(past, torch.zeros(1, 8)), forward(past, torch.ones(1, 8)))


@pytest.mark.parametrize("kind", ["strided", "impala"])
def test_every_level_halves(kind: Encoder) -> None:
    levels = ConvEncoder(6, (4, 8, 8), kind)(torch.rand(2, 6, 32, 32))
    assert [tuple(level.shape) for level in levels] == [(2, 4, 16, 16), (2, 8, 8, 8), (2, 8, 4, 4)]


def test_more_halvings_than_frames_have_are_refused() -> None:
    config = compose(["preset=smoke", "env.image_size=32", "baselines.lapo.forward_channels=[4,4,4,4,4,4]"])
    with pytest.raises(ConfigError, match=r"^baselines\.lapo\.forward_channels: got 6 widths, .*fewer"):
        config.baselines.lapo.check("baselines.lapo", config)
    with pytest.raises(ValueError, match=r"codebooks: got 3, expected a divisor of groups 8"):
        LAPOConfig(codebooks=3)


def test_a_policy_of_an_earlier_form_has_the_same_weights_and_models_of_one_are_refused(tmp_path: Path) -> None:
    config = compose(["preset=smoke"])
    old = {"channels": [8, 16], "hidden": 32, "groups": 2, "code_dim": 4, "codes": 4}
    plain = {"env": to_dict(config.env), "model": to_dict(config.model), "lapo": old}
    made = {"modules": {"x": LAPOPolicy(CONFIG, 32)}, "data": {}, "parents": {}, "metrics": {}, "steps": 1}
    done = save_stage(tmp_path / "old", stage="lapo_model", config=plain, seconds=0.0, **made)  # type: ignore[arg-type]
    own = sizes(done)
    names = {"network.encoder.levels.0.0.weight", "network.encoder.levels.1.1.second.bias", "network.mlp.2.weight"}
    assert names <= set(LAPOPolicy(own, 32).state_dict())
    with pytest.raises(CheckpointError, match=r"LAPO's models of an earlier form .*train them again") as caught:
        load_inverse(done, "cpu")
    assert "\n" not in str(caught.value)


def test_the_image_error_trains_the_inverse_model_through_the_latent(models: Models) -> None:
    inverse, forward = models
    with torch.no_grad():
        for weights in forward.ups[-1].parameters():
            weights.normal_(std=0.1)
    frames = torch.rand(4, 3, 3, 32, 32)
    alone = inverse(frames)
    (forward(frames[:, :-1], alone.z) - frames[:, -1]).square().mean().backward()
    grads = [p.grad for p in inverse.network.parameters()]
    assert all(grad is not None for grad in grads)
    assert any(bool(grad.abs().sum() > 0) for grad in grads if grad is not None)


@pytest.mark.integration
def test_training_predicts_the_change_and_the_codes_tell_directions_apart(
    models: Models,
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
    frames = source.pixels(Ends.of(source).past(moves.rows + 1, 3))
    directions: dict[tuple[int, ...], list[bool]] = {}
    for code, action in zip(inverse(frames).code.tolist(), source.actions[moves.rows, 0], strict=True):
        directions.setdefault(tuple(code), []).append(bool(action > 0))
    told = sum(max(sum(group), len(group) - sum(group)) for group in directions.values())
    assert len(directions) <= 12, "few enough for a majority to mean something"
    assert told / len(moves.rows) > 0.9


def test_latents_of_transitions_are_in_the_order_of_their_rows(models: Models) -> None:
    inverse, source = models[0].eval(), moving_square()
    moves = transitions(source)
    rows = Ends.of(source).past(moves.rows + 1, 3)
    latents, after = (inferred(partial(inverse.latents, kind), source.pixels, rows) for kind in get_args(Targets))
    assert latents.shape == (len(moves.rows), 8)
    frames = source.pixels(moves.rows[7] + np.array([[-1, 0, 1]]))
    alone = inverse(frames)
    torch.testing.assert_close(latents[7:8], alone.before, atol=1e-5, rtol=0)
    torch.testing.assert_close(after[7:8], alone.z, atol=1e-5, rtol=0)
    assert not torch.allclose(after, latents)


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
    policy, decoder = (
        LAPOPolicy(CONFIG, 32),
        ActionDecoder(ActionDecoderConfig(8), CONFIG.latent_dim, 2, CONFIG.hidden),
    )
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
