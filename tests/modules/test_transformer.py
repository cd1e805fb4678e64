"""Attention by matrix products and by torch's fused kernel."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from playslot_rl.modules import transformer
from playslot_rl.modules.transformer import PRODUCTS_UP_TO, attention, products

MASKS = {
    "none": None,
    "causal": torch.ones(5, 7, dtype=torch.bool).tril(2),
    "padding": torch.tensor([[True] * 7, [False] * 3 + [True] * 4])[:, None, None],
    "bias": torch.linspace(-2, 2, 35, dtype=torch.float64).view(5, 7),
}


@pytest.mark.parametrize("name", MASKS)
def test_short_sequences_have_the_fused_kernels_values_and_gradients(name: str) -> None:
    torch.manual_seed(0)
    shapes = ((2, 3, 5, 4), (2, 3, 7, 4), (2, 3, 7, 4))
    given = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in shapes]
    weight = torch.randn(2, 3, 5, 4, dtype=torch.float64)
    found = []
    for function in (products, F.scaled_dot_product_attention):
        out = function(*given, MASKS[name])
        found.append((out, *torch.autograd.grad((out * weight).sum(), given)))
    for got, expected in zip(*found, strict=True):
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize(
    ("dtype", "keys", "fused_calls"),
    [(torch.bfloat16, PRODUCTS_UP_TO, 0), (torch.bfloat16, PRODUCTS_UP_TO + 1, 1), (torch.float32, 4, 1)],
)
def test_only_short_sequences_in_bf16_leave_the_fused_kernel(
    dtype: torch.dtype, keys: int, fused_calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fused = F.scaled_dot_product_attention
    called = []

    def spy(*given: torch.Tensor | None) -> torch.Tensor:
        called.append(given)
        return fused(*given)

    monkeypatch.setattr(transformer.F, "scaled_dot_product_attention", spy)
    q, k, v = (torch.randn(1, 1, size, 4, dtype=dtype) for size in (2, keys, keys))
    torch.testing.assert_close(attention(q, k, v), fused(q, k, v))
    assert len(called) == fused_calls
