"""What DreamerV3 asks of TorchRL's two-hot."""

from __future__ import annotations

import pytest
import torch
from torchrl.modules import SymExpTwoHot


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
