"""Two-hot symlog grids, and the distributions of actions."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch
from torchrl.modules import SymExpTwoHot, TruncatedNormal, symlog
from torchrl.objectives import two_hot_encode

from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.methods.sold.networks import (
    MAX_STD,
    MIN_STD,
    ActorHead,
    ScalarHead,
    sample_action,
)

SIZES = SOLDConfig(dim=16, head_layers=1, heads=2, mlp_dim=16)


def _scalar_head(bins: int, mean: Literal["symlog", "linear"] = "symlog") -> ScalarHead:
    return ScalarHead(replace(SIZES, bins=bins, mean=mean), slot_dim=6)


def test_two_hot_round_trip() -> None:
    head = _scalar_head(255).double()
    values = torch.tensor([-1e6, -37.5, -1.0, -0.01, 0.0, 0.3, 8.25, 150.0, 1e7], dtype=torch.float64)
    encoded = two_hot_encode(symlog(values), head.grid)
    assert ((encoded > 0).sum(dim=-1) <= 2).all()  # two neighbours
    torch.testing.assert_close(encoded.sum(dim=-1), torch.ones_like(values))
    torch.testing.assert_close(head.decode(encoded.clamp(min=1e-300).log()), values, rtol=1e-4, atol=1e-4)


def test_the_linear_mean_on_the_sources_grid_is_torchrls() -> None:
    logits = torch.randn(20, 255, generator=torch.Generator().manual_seed(0))
    expected = SymExpTwoHot(255).decode(logits)
    torch.testing.assert_close(_scalar_head(255, "linear").decode(logits), expected, rtol=1e-4, atol=1.0)
    assert (_scalar_head(255).decode(logits) - expected).abs().min() > 1e3


def test_values_beyond_the_grid_land_on_its_ends() -> None:
    head, ends = _scalar_head(41), torch.full((2, 41), -50.0)
    ends[0, 0] = ends[1, -1] = 50.0
    assert head.cross_entropy(ends, torch.tensor([-1e30, 1e30])).tolist() == [0, 0]


def test_cross_entropy_is_least_at_the_target() -> None:
    head = _scalar_head(41)
    target = torch.tensor(5.0)
    logits = torch.zeros(41, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.3)
    for _ in range(200):
        optimizer.zero_grad()
        head.cross_entropy(logits, target).backward()
        optimizer.step()
    assert head.decode(logits).item() == pytest.approx(5.0, abs=0.1)


def test_the_decoded_value_has_gradients_of_its_own_size() -> None:
    """Averaging symexp(b_k) instead would make this 1e6 and more at flat logits."""
    logits = torch.zeros(255, requires_grad=True)
    (gradient,) = torch.autograd.grad(_scalar_head(255).decode(logits), logits)
    assert 0 < gradient.abs().max() < 1


@pytest.mark.parametrize("bins", [2, 40])
def test_grids_without_a_zero_are_refused(bins: int) -> None:
    with pytest.raises(ValueError, match=f"bins: got {bins}, expected an odd number"):
        _scalar_head(bins)


def test_an_untrained_scalar_head_says_zero() -> None:
    head = _scalar_head(41)
    assert head.decode(head(torch.randn(2, 3, 4, 6))).abs().max() < 1e-5


def test_actions_are_within_bounds_and_their_mode_is_the_location() -> None:
    torch.manual_seed(0)
    head = ActorHead(SIZES, 6, 3)
    torch.nn.init.normal_(head.out.weight, std=3.0)
    location, std, _ = head(torch.randn(50, 4, 4, 6))
    assert std.min() >= MIN_STD
    assert std.max() <= MAX_STD
    distribution = TruncatedNormal(location, std)
    action = sample_action(distribution, torch.Generator().manual_seed(0))
    assert action.shape == (50, 4, 3)
    assert action.abs().max() <= 1
    nearby = (location + 0.05 * torch.randn(location.shape)).clamp(-1, 1)
    assert (distribution.log_prob(location) >= distribution.log_prob(nearby) - 1e-5).all()


def test_samples_follow_the_distribution_and_repeat_with_the_generator() -> None:
    location, std = torch.full((40_000, 1), 0.6), torch.full((40_000, 1), 0.5)
    distribution = TruncatedNormal(location, std)
    drawn = sample_action(distribution, torch.Generator().manual_seed(3))
    assert torch.equal(drawn, sample_action(distribution, torch.Generator().manual_seed(3)))
    assert float(drawn.mean()) == pytest.approx(float(distribution.base_dist.mean[0]), abs=0.01)
    assert float(drawn.var()) == pytest.approx(float(distribution.base_dist.variance[0]), abs=0.01)


def test_samples_are_reparameterised() -> None:
    location = torch.full((1000, 1), 0.2, requires_grad=True)
    drawn = sample_action(TruncatedNormal(location, torch.full((1000, 1), 0.3)), torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad(drawn.sum(), location)
    assert gradient.min() >= 0
    assert gradient.mean() > 0.5
