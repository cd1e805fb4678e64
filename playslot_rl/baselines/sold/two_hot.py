"""Scalars as categories on a symlog grid (Hafner et al., 2023; Mosbach et al., 2025, section 3.3).

    target: two-hot(symlog(x)),   p = softmax(l),   b_k evenly spaced in [-limit, limit]
    decoded, linear: x^ = sum_k p_k symexp(b_k)      decoded, symlog: x^ = symexp(sum_k p_k b_k)

Note: the linear mean is the source's and unbiased. On its grid of +-20, values of up to 4.9e8, TorchRL's
`SymExpTwoHot` is the same. But SOLD's actor is trained through decoded rewards and values, where the gradient of a bin
of 4.9e8 drowns all others. So either the grid ends where returns do, or the mean is taken in symlog, which stays of
the size of the value and is too low where the head is uncertain (between 10 and 200 it says 46, not 105).
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.modules import symexp, symlog
from torchrl.objectives import two_hot_encode

Mean = Literal["symlog", "linear"]


class SymlogTwoHot(nn.Module):
    """Encode and decode.

    Args:
        bins: categories; odd, so that one of them is zero.
        limit: the grid's ends, in symlog; what lies beyond is encoded as the end.
        mean: how probabilities become a value.

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

    def __init__(self, bins: int, limit: float = 20.0, mean: Mean = "symlog") -> None:
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"bins: got {bins}, expected an odd number from 3 on")
        self.mean = mean
        self.register_buffer("grid", torch.linspace(-limit, limit, bins), persistent=False)

    def encode(self, values: Tensor) -> Tensor:
        """Values (...) to two-hot targets (..., bins) that sum to one."""
        encoded: Tensor = two_hot_encode(symlog(values), self.grid)
        return encoded

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) to values (...)."""
        p = torch.softmax(logits, dim=-1)
        values: Tensor = (
            (p * symexp(self.grid)).sum(dim=-1) if self.mean == "linear" else symexp((p * self.grid).sum(dim=-1))
        )
        return values

    def cross_entropy(self, logits: Tensor, values: Tensor) -> Tensor:
        """-sum_k target_k log softmax(l)_k: logits (..., bins) and values (...) to (...)."""
        return -(self.encode(values) * F.log_softmax(logits, dim=-1)).sum(dim=-1)
