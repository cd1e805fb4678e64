"""DreamerV3's objective as it is wired here: shapes, resets, returns, and what each loss moves."""

from __future__ import annotations

import torch
from dreamer_parts import A, B, Parts, T, random_batch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.methods.dreamer.learner import records, world_model
from playslot_rl.methods.sold.losses import imagined_returns
from playslot_rl.seeds.draws import global_seed

MODEL = {"encoder", "prior", "posterior", "decoder", "reward"}


def roll(parts: Parts, batch: TensorDict) -> TensorDict:
    with global_seed(0, 0), torch.no_grad():
        out: TensorDict = world_model(parts.networks)(records(batch, parts.networks))
    return out


def starts(parts: Parts) -> TensorDict:
    """States to imagine from."""
    out = roll(parts, random_batch())["next"]
    values = {key: out[key].flatten(0, 1) for key in ("state", "belief")}
    return TensorDict(values, [B * T])


def test_shapes_of_prior_posterior_and_predictions(parts: Parts) -> None:
    out = roll(parts, random_batch())["next"]
    for key in ("prior_logits", "posterior_logits"):
        assert out[key].shape == (B, T, 3, 4)
    assert out["state"].shape == (B, T, 12)
    assert torch.equal(out["state"].view(B, T, 3, 4).sum(-1), torch.ones(B, T, 3))
    assert out["belief"].shape == (B, T, 8)
    assert out["reco_pixels"].shape == (B, T, 3, 16, 16)
    assert out["reward_logits"].shape == (B, T, 255)


def test_a_first_frame_forgets_all_that_came_before_it(parts: Parts) -> None:
    batch = random_batch()
    changed = batch.clone()
    changed[keys.PIXELS][1, :3] = 255 - changed[keys.PIXELS][1, :3]
    changed[keys.ACTION][1, :4] += 1  # also the action that "led to" the first frame
    one, other = (roll(parts, each)["next"] for each in (batch, changed))
    assert torch.equal(one["belief"][1, 3:], other["belief"][1, 3:])
    assert torch.equal(one["posterior_logits"][1, 3:], other["posterior_logits"][1, 3:])
    assert not torch.equal(one["belief"][1, 1:3], other["belief"][1, 1:3])


def test_no_state_depends_on_later_frames(parts: Parts) -> None:
    batch = random_batch()
    changed = batch.clone()
    changed[keys.PIXELS][:, 3:] = 255 - changed[keys.PIXELS][:, 3:]
    one, other = (roll(parts, each)["next"] for each in (batch, changed))
    assert torch.equal(one["posterior_logits"][:, :3], other["posterior_logits"][:, :3])
    assert not torch.equal(one["posterior_logits"][:, 3:], other["posterior_logits"][:, 3:])


def test_an_action_changes_the_state_of_the_frame_it_leads_to(parts: Parts) -> None:
    batch = random_batch()
    changed = batch.clone()
    changed[keys.ACTION][0, 2] += 1
    one, other = (roll(parts, each)["next"] for each in (batch, changed))
    assert torch.equal(one["belief"][0, :2], other["belief"][0, :2])
    assert not torch.equal(one["belief"][0, 2], other["belief"][0, 2])


def test_reconstruction_is_the_squared_error_to_frames_in_0_to_1_summed_over_pixels(parts: Parts) -> None:
    batch = random_batch()
    out = roll(parts, batch)["next"]
    with global_seed(0, 0):
        losses, _ = parts.loss.model_loss(records(batch, parts.networks))
    error = (batch[keys.PIXELS].float() / 255 - out["reco_pixels"]).square().flatten(2).sum(-1).mean()
    assert torch.allclose(losses["loss_model_reco"].squeeze(), error, rtol=1e-4)


def test_imagined_returns_are_lambda_returns_of_imagined_rewards(parts: Parts) -> None:
    with global_seed(0, 1):
        _, imagined = parts.loss.actor_loss(starts(parts))
    rewards = imagined["next", keys.REWARD]
    with torch.no_grad():
        values = parts.networks.value(imagined["next", "state"], imagined["next", "belief"])[1]
    expected = imagined_returns(rewards[..., 0], values[..., 0], parts.config.gamma, parts.config.lmbda)[..., None]
    assert imagined["lambda_target"].shape == (B * T, 4, 1)
    assert torch.allclose(imagined["lambda_target"], expected, rtol=1e-3, atol=1e-4)
    weights = imagined["discount_weight"][0].flatten()
    assert torch.allclose(weights, parts.config.gamma ** torch.arange(4.0))


def test_the_scale_of_returns_follows_the_imagined_ones(parts: Parts) -> None:
    with global_seed(0, 1):
        _, imagined = parts.loss.actor_loss(starts(parts))
    target = imagined["lambda_target"].flatten()
    low, high = (0.01 * torch.quantile(target, q) for q in (0.05, 0.95))
    assert torch.allclose(parts.loss.actor_loss.return_low, low, atol=1e-6)
    assert torch.allclose(parts.loss.actor_loss.return_high, high, atol=1e-6)


def test_the_world_models_loss_moves_neither_actor_nor_critic(parts: Parts) -> None:
    with global_seed(0, 0):
        losses, _ = parts.loss.model_loss(records(random_batch(), parts.networks))
    sum(losses.values()).sum().backward()
    assert parts.touched() == MODEL


def test_the_actors_loss_moves_only_the_actor(parts: Parts) -> None:
    with global_seed(0, 1):
        losses, _ = parts.loss.actor_loss(starts(parts))
    losses["loss_actor"].backward()
    assert parts.touched() == {"actor"}


def test_the_value_loss_moves_only_the_critic(parts: Parts) -> None:
    with global_seed(0, 1):
        _, imagined = parts.loss.actor_loss(starts(parts))
    parts.loss.value_loss(imagined)[0]["loss_value"].backward()
    assert parts.touched() == {"value"}


def test_the_critics_loss_on_replayed_rewards_also_trains_the_representation(parts: Parts) -> None:
    with global_seed(0, 0):
        losses = parts.loss(records(random_batch(), parts.networks))
    losses["loss_replay_value"].backward()
    assert parts.touched() == {"encoder", "prior", "posterior", "value"}


def test_rewards_of_the_next_episode_do_not_reach_the_values_of_the_last(parts: Parts) -> None:
    batch = random_batch()
    batch[keys.IS_FIRST][:, 1:], batch[keys.IS_LAST][:] = False, False
    batch[keys.IS_LAST][:, 3], batch[keys.IS_FIRST][:, 4] = True, True
    found = []
    for raised in (None, 3, 4):
        changed = batch.clone()
        if raised is not None:
            changed[keys.REWARD][:, raised] += 5
        with global_seed(0, 0), torch.no_grad():
            found.append(parts.loss(records(changed, parts.networks))["loss_replay_value"].item())
    assert found[1] != found[0]
    assert found[2] == found[0]


def test_actions_are_bounded_gaussians_that_start_wide_and_centred(parts: Parts) -> None:
    mean, std = parts.networks.actor(torch.randn(100, 12), torch.randn(100, 8))
    assert mean.shape == std.shape == (100, A)
    assert mean.abs().max() < 0.2
    assert ((std > 0.8) & (std < 1.0)).all()
