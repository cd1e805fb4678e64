"""Scalars as categories on a symlog grid (Hafner et al., 2023; Mosbach et al., 2025, section 3.3).

    target: two-hot(symlog(x)),   decoded: x^ = symexp(sum_k softmax(l)_k b_k),   b_k evenly spaced in [-20, 20]

Note: TorchRL's `SymExpTwoHot` averages symexp(b_k) instead, up to 4.9e8 each. That suits a loss through which no
gradient runs. SOLD's actor is trained through the decoded rewards and values, and there the gradient of a bin of 4.9e8
drowns all others; averaged before symexp, they stay of the size of the value.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.modules import symexp, symlog
from torchrl.objectives import two_hot_encode

LIMIT = 20.0
"""The grid's ends, in symlog: values up to 4.9e8."""


class SymlogTwoHot(nn.Module):
    """Encode and decode.

    Args:
        bins: categories, at least 2; odd, so that one of them is zero.

    Raises:
        ValueError: even, or fewer than 3.

    Example:
        >>> import torch
        >>> two_hot = SymlogTwoHot(255)
        >>> x = torch.tensor([-3.5, 0.0, 120.0])
        >>> torch.allclose(two_hot.decode(two_hot.encode(x).clamp(min=1e-30).log()), x, rtol=1e-4)
        True
    """

    grid: Tensor

    def __init__(self, bins: int) -> None:
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"bins: got {bins}, expected an odd number from 3 on")
        self.register_buffer("grid", torch.linspace(-LIMIT, LIMIT, bins), persistent=False)

    def encode(self, values: Tensor) -> Tensor:
        """Values (...) to two-hot targets (..., bins) that sum to one."""
        encoded: Tensor = two_hot_encode(symlog(values), self.grid)
        return encoded

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) to values (...)."""
        values: Tensor = symexp((torch.softmax(logits, dim=-1) * self.grid).sum(dim=-1))
        return values

    def cross_entropy(self, logits: Tensor, values: Tensor) -> Tensor:
        """-sum_k target_k log softmax(l)_k: logits (..., bins) and values (...) to (...)."""
        return -(self.encode(values) * F.log_softmax(logits, dim=-1)).sum(dim=-1)
