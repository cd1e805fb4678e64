"""Scalars as a categorical over symexp-spaced bins: the symlog two-hot of DreamerV3, which TorchRL ships.

`SymExpTwoHot(255)` holds the bins symexp(-20) ... symexp(20): `encode` puts a scalar's weight on its two neighbours,
`loss` is the cross entropy of logits with that, and calling it decodes logits (..., 255) to the expectation (..., 1).
"""

from torchrl.modules import SymExpTwoHot

__all__ = ["SymExpTwoHot"]
