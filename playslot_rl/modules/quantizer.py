"""Action prototypes: the vector quantiser (paper, appendix A.2; van den Oord et al., 2017).

    p = e_k,  k = argmin_j |z - e_j|;   z = p + v;   L_VQ = |sg[z] - p|^2 + beta |z - sg[p]|^2

The codebook e (K, Z) follows an exponential moving average, so the first term has no gradient and only the commitment
term is returned. Straight-through: d p / d z = 1; the variability is v = z - sg[p], so d v / d z = 1.

Note: the authors' EMA keeps 5 % of the old value a step and never revives a dead code; we keep 99 % and replace a code
whose EMA cluster size falls below a threshold by a random latent of the batch.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from vector_quantize_pytorch import VectorQuantize


class ActionQuantizer(nn.Module):
    """vector-quantize-pytorch's EMA codebook in the paper's symbols.

    Args:
        latent_dim: Z.
        n_prototypes: K.
        decay: EMA decay.
        dead_threshold: EMA cluster size below which a code is revived.
        commitment: beta.
    """

    def __init__(
        self, latent_dim: int, n_prototypes: int, decay: float, dead_threshold: float, commitment: float
    ) -> None:
        super().__init__()
        self.vq = VectorQuantize(
            dim=latent_dim,
            codebook_size=n_prototypes,
            decay=decay,
            threshold_ema_dead_code=dead_threshold,
            commitment_weight=commitment,
            kmeans_init=True,
            rotation_trick=False,
        )

    @property
    def prototypes(self) -> Tensor:
        """The codebook (K, Z)."""
        return cast(Tensor, self.vq.codebook)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quantise.

        Args:
            z: latent actions (..., Z).

        Returns:
            p (..., Z) with a straight-through gradient, code (...) int64, and the commitment loss (scalar, beta
            included). In training mode the codebook is updated.
        """
        flat = z.reshape(1, -1, z.shape[-1])
        quantized, code, loss = self.vq(flat)
        # The library passes z through in training mode only; here the gradient is the same in both modes.
        p = z + (quantized.detach().reshape(z.shape) - z).detach()
        return p, code.reshape(z.shape[:-1]), loss.sum()


def usage(code: Tensor, n_prototypes: int) -> tuple[Tensor, Tensor]:
    """Fraction of the codes in use, and perplexity exp(H) of their frequencies (1 to K)."""
    counts = torch.bincount(code.flatten(), minlength=n_prototypes).float()
    frequency = counts / counts.sum().clamp(min=1)
    entropy = -(frequency * frequency.clamp(min=1e-12).log()).sum()
    return (counts > 0).float().mean(), entropy.exp()
