"""Action prototypes: the vector quantiser (paper, appendix A.2; van den Oord et al., 2017).

    p = e_k,  k = argmin_j |z - e_j|;   z = p + v;   L_VQ = |sg[z] - p|^2 + beta |z - sg[p]|^2

The codebook e (K, Z) follows an exponential moving average, so the first term has no gradient and only the commitment
term is returned. Straight-through: d p / d z = 1; the variability is v = z - sg[p], so d v / d z = 1.

Note: the authors' EMA keeps 5 % of the old value a step and never revives a dead code; we keep 99 % and replace a code
whose EMA cluster size falls below a threshold by a random latent of the batch.

The codebook's start, its average and the revival are those of the global batch, whatever share of it is computed here
(`playslot_rl.runtime.shares`): every process runs them on the latents of all, so that all have the same codebook.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from vector_quantize_pytorch import VectorQuantize

from playslot_rl.runtime.processes import here
from playslot_rl.runtime.shares import all_rows, share


class ActionQuantizer(nn.Module):
    """vector-quantize-pytorch's EMA codebook in the paper's symbols.

    Args:
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
            sync_codebook=False,  # else decided, for good, by whether there is a process group at this moment
        )
        self._waiting: list[Tensor] = []

    @property
    def prototypes(self) -> Tensor:
        """The codebook (K, Z)."""
        return cast(Tensor, self.vq.codebook)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quantise latent actions (..., Z).

        Returns:
            p (..., Z) with a straight-through gradient, code (...) int64, and the commitment loss (scalar, beta
            included). In training mode the codebook is updated.
        """
        flat = z.reshape(1, -1, z.shape[-1])
        if self.training and share().count > 1:
            quantized, code, loss = self._shared(flat)
        else:
            quantized, code, loss = self.vq(flat)
        # The library passes z through in training mode only; here the gradient is the same in both modes.
        p = z + (quantized.detach().reshape(z.shape) - z).detach()
        return p, code.reshape(z.shape[:-1]), loss.sum()

    @property
    def starts_from_a_batch(self) -> bool:
        """Whether the first global batch, which k-means starts from, is still to come."""
        return not bool(self.vq._codebook.initted)

    def _shared(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quantise a share (1, M, Z) of the global batch, and move the codebook with all of it."""
        own, seen = share(), flat.detach()
        if own.micros == 1:
            quantized, code, _ = self.vq(all_rows(seen[0])[None])
            first = here().rank * flat.shape[1]
            quantized, code = (x[:, first : first + flat.shape[1]] for x in (quantized, code))
        elif own.rehearsal:
            quantized, code = seen, torch.zeros(seen.shape[:-1], dtype=torch.long, device=seen.device)
        else:
            quantized, code, _ = self.vq(seen, freeze_codebook=True)
        if own.micros > 1:
            self._gather(seen[0])
        return quantized, code, self.vq.commitment_weight * F.mse_loss(quantized.detach(), flat)

    @torch.no_grad()
    def _gather(self, seen: Tensor) -> None:
        """Keep the latents (M, Z) of a micro-batch; after the last one the codebook starts from them all, or moves."""
        own = share()
        self._waiting = [*self._waiting, seen] if own.micro else [seen]
        if own.micro < own.micros - 1:
            return
        every, self._waiting = all_rows(torch.cat(self._waiting))[None], []
        if own.rehearsal:
            self.vq._codebook.init_embed_(every)
        else:
            self.vq(every)


def usage(code: Tensor, n_prototypes: int) -> tuple[Tensor, Tensor]:
    """Fraction of the codes in use, and perplexity exp(H) of their frequencies (1 to K), of the global batch."""
    counts = torch.bincount(all_rows(code.flatten()), minlength=n_prototypes).float()
    frequency = counts / counts.sum().clamp(min=1)
    entropy = -(frequency * frequency.clamp(min=1e-12).log()).sum()
    return (counts > 0).float().mean(), entropy.exp()
