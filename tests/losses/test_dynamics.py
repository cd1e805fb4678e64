"""The dynamics loss: InvDyn and cOCVP on frozen slots."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.config import DynamicsStageConfig, LatentMode
from playslot_rl.losses import DynamicsLoss, total_loss
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import WorldModel

CONFIG = DynamicsStageConfig(seed_frames=2, predicted_frames=4)
T = 6


def model_of(mode: LatentMode = "hybrid", kind: Literal["cocvp", "ocvp_seq"] = "cocvp") -> WorldModel:
    config = tiny_config(mode)
    predictor = replace(config.model.predictor, kind=kind)
    return tiny_agent(replace(config, model=replace(config.model, predictor=predictor))).world_model


def loss_of(model: WorldModel, config: DynamicsStageConfig = CONFIG) -> DynamicsLoss:
    return DynamicsLoss(model.inverse_dynamics, model.predictor, model.savi, config)


def clips(batch: int = 3, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    pixels = torch.randint(256, (batch, T, 3, 64, 64), dtype=torch.uint8, generator=g)
    slots, actions = torch.randn(batch, T, 4, 32, generator=g), torch.rand(batch, T, 4, generator=g) * 2 - 1
    return TensorDict({keys.PIXELS: pixels, keys.SLOTS: slots, keys.ACTION: actions}, [batch])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@torch.no_grad()
def test_it_is_the_mean_over_all_steps_of_an_autoregressive_rollout() -> None:
    model, batch = model_of(), clips()
    out = loss_of(model).eval()(batch)
    slots, frames = batch[keys.SLOTS], batch[keys.PIXELS].float() / 255
    latent = model.inverse_dynamics(slots)
    predicted = model.predictor.rollout_full(slots[:, :2], latent.prototype, latent.variability)
    assert predicted.shape[1] == T - 1, "steps inside the seed count too"
    torch.testing.assert_close(out["mse_slot"], (predicted - slots[:, 1:]).square().mean(), atol=1e-5, rtol=1e-5)
    rendered = model.savi.decode(predicted).frames
    torch.testing.assert_close(out["mse_image"], (rendered - frames[:, 1:]).square().mean(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(out["loss_vq"], 0.25 * latent.vq_loss)


@torch.no_grad()
def test_teacher_forcing_is_a_rollout_whose_seed_is_the_whole_clip() -> None:
    model, batch = model_of(), clips()
    taught = loss_of(model).eval()(batch, teacher=True)
    whole = loss_of(model, replace(CONFIG, seed_frames=T - 1)).eval()(batch)
    rolled = loss_of(model).eval()(batch)
    torch.testing.assert_close(taught["mse_slot"], whole["mse_slot"], atol=1e-5, rtol=1e-5)
    assert (taught["mse_slot"] - rolled["mse_slot"]).abs() > 1e-4


@torch.no_grad()
def test_the_image_loss_on_a_random_subset_is_unbiased() -> None:
    model, batch = model_of(), clips(2)
    full = loss_of(model).eval()(batch)["mse_image"]
    some = loss_of(model, replace(CONFIG, decoded_frames=2)).eval()
    model.predictor.train()  # without dropout: it says that some are drawn
    draws = torch.stack([some(batch, generator=seeded(seed))["mse_image"] for seed in range(60)])
    assert draws.std() > 0
    assert (draws.mean() - full).abs() < 4 * draws.std() / 60**0.5


@torch.no_grad()
def test_what_validates_is_the_mean_psnr_of_every_clamped_frame_past_the_seed() -> None:
    model, batch = model_of(), clips(2)
    judged = loss_of(model, replace(CONFIG, decoded_frames=1)).eval()(batch)["psnr"]
    latent = model.inverse_dynamics(batch[keys.SLOTS])
    predicted = model.predictor.rollout(
        batch[keys.SLOTS][:, : CONFIG.seed_frames], latent.prototype, latent.variability
    )
    frames = model.savi.decode(predicted).frames.clamp(0, 1)[:, CONFIG.seed_frames - 1 :]
    true = batch[keys.PIXELS][:, CONFIG.seed_frames :].float() / 255
    each = -10 * ((frames - true).square().mean((2, 3, 4)) + 1e-8).log10()
    assert judged == pytest.approx(float(each.mean()), abs=1e-4)


@torch.no_grad()
def test_decoding_all_frames_and_zero_mean_the_same() -> None:
    model, batch = model_of(), clips()
    for count in (T - 1, T + 5):
        got = loss_of(model, replace(CONFIG, decoded_frames=count)).eval()(batch)["mse_image"]
        assert torch.equal(got, loss_of(model).eval()(batch)["mse_image"])


@torch.no_grad()
def test_weights_are_applied_once_and_not_to_what_is_logged() -> None:
    model, batch = model_of(), clips()
    config = replace(CONFIG, image_weight=2.0, slot_weight=3.0, vq_weight=5.0)
    one, other = loss_of(model, replace(CONFIG, vq_weight=1.0)).eval()(batch), loss_of(model, config).eval()(batch)
    for name, weight in (("image", 2.0), ("slot", 3.0), ("vq", 5.0)):
        torch.testing.assert_close(other[f"loss_{name}"], weight * one[f"loss_{name}"])
    assert torch.equal(one["mse_image"], other["mse_image"])
    parts = other["loss_image"] + other["loss_slot"] + other["loss_vq"]
    torch.testing.assert_close(total_loss(other), parts)


@torch.no_grad()
def test_losses_are_means_so_a_batch_twice_as_large_costs_the_same() -> None:
    model, batch = model_of(), clips()
    loss = loss_of(model).eval()
    once, twice = loss(batch), loss(torch.cat([batch, batch]))
    torch.testing.assert_close(total_loss(once), total_loss(twice), atol=1e-5, rtol=1e-5)


def test_savi_is_frozen_and_the_image_term_goes_through_its_decoder() -> None:
    model = model_of()
    loss = loss_of(model, replace(CONFIG, slot_weight=0.0, vq_weight=0.0)).train()
    assert not model.savi.training
    assert model.predictor.training
    total_loss(loss(clips(), generator=seeded())).backward()
    assert all(p.grad is None for p in model.savi.parameters())
    for trained in (model.predictor.head.weight, model.inverse_dynamics.to_mean.weight):
        assert trained.grad is not None
        assert trained.grad.abs().sum() > 0


def test_latents_are_sampled_in_training_by_the_generator_alone() -> None:
    # LossModule.forward runs under deterministic exploration, which must not turn samples into means.
    first, same, other, mean = (
        loss_of(model_of("continuous")).train(training)(clips(), generator=seeded(seed))["mse_slot"]
        for training, seed in ((True, 0), (True, 0), (True, 1), (False, 0))
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    assert not torch.equal(first, mean)


@pytest.mark.parametrize("mode", ["hybrid", "discrete", "continuous", "ground_truth"])
def test_all_latent_action_modes_train(mode: LatentMode) -> None:
    model = model_of(mode)
    out = loss_of(model).train()(clips(), generator=seeded())
    total_loss(out).backward()
    assert torch.isfinite(total_loss(out))
    assert 1 <= out["perplexity"] <= 5.001
    assert 0 < out["usage"] <= 1
    if mode == "ground_truth":
        assert keys.ACTION in loss_of(model).in_keys
        assert out["loss_vq"] == 0


@pytest.mark.parametrize("kind", ["cocvp", "ocvp_seq"])
def test_a_world_model_with_either_predictor_learns_through_p_and_v(kind: Literal["cocvp", "ocvp_seq"]) -> None:
    model, batch = model_of(kind=kind), clips()
    loss = loss_of(model, replace(CONFIG, image_weight=0.0, vq_weight=0.0)).train()
    optimizer = torch.optim.Adam([*model.predictor.parameters(), *model.inverse_dynamics.parameters()], lr=1e-3)
    errors = []
    for _ in range(10):
        error = total_loss(loss(batch, generator=seeded()))
        optimizer.zero_grad()
        error.backward()
        errors.append(error.item())
        gradient = model.inverse_dynamics.to_mean.weight.grad
        optimizer.step()
    assert gradient is not None
    assert gradient.abs().sum() > 0, "none reached the latent actions"
    assert errors[-1] < 0.9 * errors[0], errors


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match=r"got no 'action', expected \(B, T, A\)"):
        loss_of(model_of("ground_truth"))(clips().exclude(keys.ACTION))
    with pytest.raises(ValueError, match=r"got 6 frames, expected more than dynamics.seed_frames=6"):
        loss_of(model_of(), replace(CONFIG, seed_frames=6))(clips())
    with pytest.raises(ValueError, match=r"expected some named loss_\*"):
        total_loss(TensorDict({"psnr": torch.zeros(())}))
