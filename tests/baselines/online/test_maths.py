"""Two-hot, lambda returns, and the normaliser of returns, against plain loops and closed forms."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.baselines.online.normaliser import PercentileValueNorm
from playslot_rl.baselines.online.returns import lambda_returns
from playslot_rl.baselines.online.two_hot import SymExpTwoHot


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0, 1e5])
def test_two_hot_round_trip(scale: float) -> None:
    codec = SymExpTwoHot(255)
    x = torch.randn(200, generator=torch.Generator().manual_seed(0)) * scale
    encoded = codec.encode(x)
    assert torch.allclose(encoded.sum(-1), torch.ones(200))
    assert ((encoded > 0).sum(-1) <= 2).all()
    assert torch.allclose(codec.decode(encoded.clamp(min=1e-38).log()), x, rtol=1e-3, atol=1e-3)


def test_two_hot_bins_are_symexp_of_an_even_grid() -> None:
    bins = SymExpTwoHot(255).bins
    grid = torch.linspace(-20, 20, 255)
    assert torch.allclose(bins, grid.sign() * grid.abs().expm1(), rtol=1e-4, atol=1e-5)


def test_equal_logits_mean_exactly_zero() -> None:
    assert (SymExpTwoHot(255)(torch.zeros(3, 255)) == 0).all()


def test_two_hot_loss_is_least_at_the_target() -> None:
    codec = SymExpTwoHot(255)
    target = torch.tensor([3.7])
    logits = codec.encode(target).clamp(min=1e-9).log()
    entropy = -(codec.encode(target) * codec.encode(target).clamp(min=1e-9).log()).sum()
    assert torch.allclose(codec.loss(logits, target), entropy, atol=1e-4)
    assert codec.loss(codec.encode(torch.tensor([5.0])).clamp(min=1e-9).log(), target) > entropy + 1


@pytest.mark.parametrize("gamma, lmbda", [(0.96, 0.95), (1.0, 0.0), (0.9, 1.0)])
def test_lambda_returns_against_a_plain_loop(gamma: float, lmbda: float) -> None:
    generator = torch.Generator().manual_seed(1)
    rewards, values = (torch.randn(5, 7, 1, generator=generator) for _ in range(2))
    expected = torch.empty(5, 7, 1)
    following = values[:, -1]
    for step in reversed(range(7)):
        following = rewards[:, step] + gamma * ((1 - lmbda) * values[:, step] + lmbda * following)
        expected[:, step] = following
    assert torch.allclose(lambda_returns(rewards, values, gamma, lmbda), expected, atol=1e-5)


def test_lambda_returns_pass_gradients_to_rewards_and_values() -> None:
    rewards, values = torch.zeros(1, 3, 1, requires_grad=True), torch.zeros(1, 3, 1, requires_grad=True)
    lambda_returns(rewards, values, 0.5, 1.0)[0, 0].sum().backward()
    assert rewards.grad is not None
    assert values.grad is not None
    assert torch.allclose(rewards.grad.flatten(), torch.tensor([1.0, 0.5, 0.25]))
    assert torch.allclose(values.grad.flatten(), torch.tensor([0.0, 0.0, 0.125]))


def test_the_scale_of_returns_is_the_average_of_their_percentile_range_and_at_least_one() -> None:
    norm = PercentileValueNorm(rate=0.01, min_scale=1.0)
    returns = torch.linspace(0, 1000, 1001).unsqueeze(-1)
    low = high = 0.0
    for _ in range(3):
        norm.update(returns)
        low, high = 0.99 * low + 0.01 * 50, 0.99 * high + 0.01 * 950
    assert torch.allclose(norm.scale(), torch.tensor([high - low]), rtol=1e-4)
    small = PercentileValueNorm(rate=1.0, min_scale=1.0)
    small.update(0.001 * returns / 1000)
    assert small.scale().item() == 1.0
