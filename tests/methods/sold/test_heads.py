"""Two-hot symlog grids, and the distributions of actions."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch
from torchrl.modules import SymExpTwoHot, symlog
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


def test_the_linear_mean_on_the_sources_grid_is_torchrls_and_the_sources_is_in_symlog() -> None:
    logits = torch.randn(20, 255, generator=torch.Generator().manual_seed(0))
    expected = SymExpTwoHot(255).decode(logits)
    torch.testing.assert_close(_scalar_head(255, "linear").decode(logits), expected, rtol=1e-4, atol=1.0)
    mean = (logits.softmax(-1) * torch.linspace(-20, 20, 255)).sum(-1)
    torch.testing.assert_close(_scalar_head(255).decode(logits), mean.sign() * mean.abs().expm1(), rtol=1e-4, atol=1e-5)


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


def test_a_head_is_a_hidden_layer_rms_norm_and_silu() -> None:
    head = _scalar_head(41)
    torch.nn.init.normal_(head.out.weight)
    slots = torch.randn(2, 3, 4, 6)
    x = head.hidden[0](head.backbone(slots)[0])
    x = x / (x.square().mean(dim=-1, keepdim=True) + 1e-6).sqrt() * head.hidden[1].weight
    torch.testing.assert_close(head(slots), head.out(x * x.sigmoid()))


def test_the_actions_mean_is_clamped_before_its_tanh() -> None:
    torch.manual_seed(0)
    head = ActorHead(SIZES, 6, 3)
    torch.nn.init.normal_(head.out.weight, std=3.0)
    mean, std, _ = head(torch.randn(50, 4, 4, 6))
    torch.testing.assert_close(mean.abs().max(), torch.tensor(1.0).tanh())
    assert std.min() >= MIN_STD
    assert std.max() <= MAX_STD


def test_samples_follow_the_distribution_unclamped_and_repeat_with_the_generator() -> None:
    mean, std = torch.full((40_000, 1), 0.6, requires_grad=True), torch.full((40_000, 1), 0.5)
    drawn = sample_action(mean, std, torch.Generator().manual_seed(3))
    assert torch.equal(drawn, sample_action(mean, std, torch.Generator().manual_seed(3)))
    assert drawn.detach().mean().item() == pytest.approx(0.6, abs=0.01)
    assert drawn.detach().std().item() == pytest.approx(0.5, abs=0.01)
    assert drawn.max() > 1
    assert torch.equal(torch.autograd.grad(drawn.sum(), mean)[0], torch.ones_like(mean))
