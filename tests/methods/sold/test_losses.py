"""SOLD's losses against plain loops, and what their gradients reach."""

from __future__ import annotations

import pytest
import torch
from torchrl.modules import PercentileValueNorm

from playslot_rl.methods.sold import losses
from playslot_rl.methods.sold.losses import Imagined


def _imagined(batch: int = 2, horizon: int = 3) -> Imagined:
    zeros = torch.zeros(batch, horizon)
    return Imagined(torch.zeros(batch, 1 + horizon, 1, 1), zeros.unsqueeze(-1), zeros, zeros, zeros.unsqueeze(-1))


@pytest.mark.parametrize(("gamma", "lmbda"), [(0.9, 0.8), (1.0, 0.0), (0.9, 1.0)])
def test_lambda_returns_equal_a_plain_loop(gamma: float, lmbda: float) -> None:
    torch.manual_seed(0)
    rewards, values = torch.randn(4, 6), torch.randn(4, 6)
    expected = torch.zeros(4, 6)
    following = values[:, -1]
    for t in reversed(range(6)):
        following = rewards[:, t] + gamma * ((1 - lmbda) * values[:, t] + lmbda * following)
        expected[:, t] = following
    torch.testing.assert_close(losses.imagined_returns(rewards, values, gamma, lmbda), expected)


def test_lambda_returns_are_differentiable_in_rewards_and_values() -> None:
    rewards = torch.zeros(1, 3, requires_grad=True)
    values = torch.zeros(1, 3, requires_grad=True)
    first = losses.imagined_returns(rewards, values, 0.5, 0.5)[0, 0]
    by_rewards, by_values = torch.autograd.grad(first, (rewards, values))
    torch.testing.assert_close(by_rewards, torch.tensor([[1.0, 0.25, 0.0625]]))
    torch.testing.assert_close(by_values, torch.tensor([[0.25, 0.0625, 0.03125]]))


def test_the_scale_of_returns_is_an_average_of_the_percentile_range_and_at_least_one() -> None:
    norm = PercentileValueNorm(rate=0.01, min_scale=1.0)
    returns = torch.linspace(0, 1000, 1001).unsqueeze(-1)
    norm.update(returns)
    assert norm.scale().item() == pytest.approx(0.01 * 900)
    norm.update(returns)
    assert norm.scale().item() == pytest.approx((1 - 0.99**2) * 900)
    small = PercentileValueNorm(rate=0.01, min_scale=1.0)
    small.update(returns / 1000)
    assert small.scale().item() == 1


def test_frames_after_a_reset_are_another_episode() -> None:
    is_first = torch.tensor([[True, False, False, False], [False, False, True, False]])
    assert losses.same_episode(is_first).tolist() == [[True] * 4, [True, True, False, False]]


def test_frames_of_another_episode_do_not_count() -> None:
    predicted, slots = torch.zeros(1, 3, 2, 4), torch.ones(1, 3, 2, 4)
    slots[:, 2] = torch.nan
    valid = torch.tensor([[True, True, False]])
    assert losses.slot_loss(predicted, slots, valid).item() == 1


def test_the_actor_is_paid_for_returns_by_the_scale_and_for_entropy() -> None:
    returns, weights = torch.full((2, 3), 6.0), torch.tensor([1.0, 0.5, 0.25])
    imagined = _imagined()._replace(entropies=torch.full((2, 3), 10.0))
    loss = losses.actor_loss(imagined, returns, returns, torch.tensor([2.0]), weights, 0.1, "dynamics")
    assert loss.item() == pytest.approx(-(6 / 2 + 0.1 * 10) * 1.75 / 3)


def test_reinforce_raises_the_probability_of_better_than_expected_actions_only() -> None:
    log_probs = torch.zeros(1, 2, requires_grad=True)
    returns = torch.tensor([[3.0, 1.0]], requires_grad=True)
    imagined = _imagined(1, 2)._replace(log_probs=log_probs)
    loss = losses.actor_loss(imagined, returns, torch.full((1, 2), 2.0), torch.ones(1), torch.ones(2), 0.0, "reinforce")
    by_probability, by_returns = torch.autograd.grad(loss, (log_probs, returns), allow_unused=True)
    assert by_probability.tolist() == [[-0.5, 0.5]]
    assert by_returns is None


def test_what_the_slow_critic_says_weighs_a_tenth() -> None:
    class Head:
        def cross_entropy(self, logits: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
            return logits[..., 0] * values

    returns, slow = torch.full((2, 3), 2.0), torch.full((2, 3), 30.0)
    weights = torch.tensor([1.0, 0.5, 0.25])
    loss = losses.value_loss(Head(), torch.ones(2, 3, 1), returns, slow, weights, 0.1)  # type: ignore[arg-type]
    assert loss.item() == pytest.approx((2 + 0.1 * 30) * 1.75 / 3)
