"""Whitened coordinates of latent actions.

    c = (z - m) V / sqrt(lambda + eps lambda_1),   z = m + c sqrt(lambda + eps lambda_1) V^T

with mean m (Z,), eigenvectors V (Z, Z) and eigenvalues lambda_1 >= ... >= lambda_Z of the training latents' covariance,
and eps = 0.01. A handful of directions holds nearly all of the latents' variance; in these coordinates each of them has
unit scale, and those below a hundredth of the first fade out instead of being blown up.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn

FADE: Final = 0.01
"""eps."""


class Whitening(nn.Module):
    """An invertible linear map of latent actions (..., Z) to coordinates (..., Z); the identity until it is fitted.

    Examples:
        >>> z = torch.randn(100, 3) * torch.tensor([5.0, 1.0, 1e-4]) + 2.0
        >>> whitening = Whitening(3)
        >>> whitening.fit(z)
        >>> [round(float(s), 1) for s in whitening(z).std(dim=0)]
        [1.0, 0.9, 0.0]
        >>> bool(torch.allclose(whitening.inverse(whitening(z)), z, atol=1e-5))
        True
    """

    mean: Tensor
    basis: Tensor
    scale: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("basis", torch.eye(width))
        self.register_buffer("scale", torch.ones(width))

    @torch.no_grad()
    def fit(self, z: Tensor) -> None:
        """Take mean, directions and scales from latent actions (M, Z); computed in double precision."""
        values = z.double()
        mean = values.mean(dim=0)
        covariance = (values - mean).T @ (values - mean) / max(1, len(values) - 1)
        eigenvalues, vectors = torch.linalg.eigh(covariance)
        spread = eigenvalues.flip(0).clamp(min=0)
        self.mean.copy_(mean)
        self.basis.copy_(vectors.flip(1))
        self.scale.copy_((spread + FADE * spread[0].clamp(min=1e-12)).sqrt())

    def forward(self, z: Tensor) -> Tensor:
        """Latent actions to coordinates."""
        return self.turn(z - self.mean)

    def turn(self, difference: Tensor) -> Tensor:
        """The difference of two latent actions to that of their coordinates."""
        return difference @ self.basis / self.scale

    def inverse(self, coordinates: Tensor) -> Tensor:
        """Coordinates to latent actions."""
        return self.mean + (coordinates * self.scale) @ self.basis.T
