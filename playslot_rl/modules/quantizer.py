"""Action prototypes: the vector quantiser (paper, appendix A.2; van den Oord et al., 2017).

    p = e_k,  k = argmin_j |z - e_j|;   z = p + v;   L_VQ = |sg[z] - p|^2 + beta |z - sg[p]|^2

The codebook e (K, Z) follows an exponential moving average, so the first term has no gradient and only the commitment
term is returned. Straight-through: d p / d z = 1; the variability is v = z - sg[p], so d v / d z = 1.

    n_k <- d n_k + (1 - d) #_k,   s_k <- d s_k + (1 - d) sum_{i: k_i = k} z_i,   e_k = s_k / n_k     (n_k smoothed)

Note: the authors' EMA keeps 5 % of the old value a step and never revives a dead code; we keep 99 % and replace a code
whose n_k falls below a threshold by a random latent of the batch.

The codebook's start, its average and the revival are those of the global batch, whatever share of it is computed here
(`playslot_rl.runtime.shares`): every process runs them on the latents of all, so that all have the same codebook.

Shapes: M latents, K codes, Z their width. The buffers have a first dimension of one, as earlier checkpoints do.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from playslot_rl.runtime.processes import here
from playslot_rl.runtime.shares import all_rows, drawn, share

KMEANS_ITERATIONS = 10
SMOOTHING = 1e-5


class EMACodebook(nn.Module):
    """K codes that follow their latents. It starts from k-means of the first batch that it sees; after that nothing
    branches on values, so that a step can be captured and never waits for the device.
    """

    initted: Tensor
    cluster_size: Tensor
    embed_avg: Tensor
    embed: Tensor

    def __init__(self, latent_dim: int, n_prototypes: int, decay: float, dead_threshold: float) -> None:
        super().__init__()
        self.decay, self.dead_threshold, self._begun = decay, dead_threshold, False
        self.register_buffer("initted", torch.tensor(False))
        self.register_buffer("cluster_size", torch.ones(1, n_prototypes))
        self.register_buffer("embed_avg", torch.zeros(1, n_prototypes, latent_dim))
        self.register_buffer("embed", torch.zeros(1, n_prototypes, latent_dim))

    @property
    def begun(self) -> bool:
        """Whether there are codes; the device is asked until there are."""
        self._begun = self._begun or bool(self.initted)
        return self._begun

    def nearest(self, z: Tensor) -> Tensor:
        """The number of the nearest code, int64 (M,), of latents (M, Z)."""
        return _nearest(z, self.embed[0].to(z.dtype))

    def quantize(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest codes of latents (M, Z), and their numbers int64 (M,); of the first batch after `start`."""
        self.start(z)
        k = self.nearest(z)
        return self.embed[0][k], k

    @torch.no_grad()
    def start(self, z: Tensor) -> None:
        """k-means of latents (M, Z), where no batch was seen yet; with fewer latents than codes some are equal."""
        if self.begun:
            return
        count, width = self.embed.shape[1:]
        means, hits = z[_sample(len(z), count, z.device)], z.new_zeros(count)
        for _ in range(KMEANS_ITERATIONS):
            k = _nearest(z, means)
            hits = z.new_zeros(count).scatter_add_(0, k, torch.ones_like(z[:, 0]))
            sums = z.new_zeros(count, width).scatter_add_(0, k[:, None].expand(-1, width), z)
            means = torch.where(hits[:, None] == 0, means, sums / hits.clamp(min=1)[:, None])
        self.embed_avg.copy_(means * hits[:, None])
        self.cluster_size.copy_(hits)
        self._divide()
        self.initted.fill_(True)
        self._begun = True

    @torch.no_grad()
    def follow(self, z: Tensor, k: Tensor) -> None:
        """Move the codes towards their latents (M, Z), of codes k (M,), and revive those that have nearly none."""
        chosen = one_hot(k, self.embed.shape[1]).to(z.dtype)[None]
        hits, sums = chosen.sum(1), torch.einsum("hnd,hnc->hcd", z[None], chosen).contiguous()
        self.cluster_size.lerp_(hits.to(self.cluster_size.dtype), 1 - self.decay)
        self.embed_avg.lerp_(sums.to(self.embed_avg.dtype), 1 - self.decay)
        self._divide()
        if self.dead_threshold > 0:
            self._revive(z)

    def _divide(self) -> None:
        n = self.cluster_size
        total = n.sum(-1, keepdim=True)
        smooth = (n + SMOOTHING) / (total + n.shape[1] * SMOOTHING) * total
        self.embed.copy_(self.embed_avg / smooth[..., None])

    def _revive(self, z: Tensor) -> None:
        """The i-th dead code becomes the i-th of candidates, drawn in every step; beyond them codes stay dead."""
        most = min(self.embed.shape[1], len(z))
        count, device = len(z), z.device
        rows = drawn(lambda: torch.randperm(count, device=device)[:most])
        dead = self.cluster_size[0] < self.dead_threshold
        rank = dead.long().cumsum(0) - 1
        dead = dead & (rank < most)
        fresh = z.to(self.embed.dtype)[rows][rank.clamp(0, most - 1)]
        self.embed.copy_(torch.where(dead[:, None], fresh, self.embed[0]))
        self.embed_avg.copy_(torch.where(dead[:, None], fresh * self.dead_threshold, self.embed_avg[0]))
        self.cluster_size.copy_(torch.where(dead, self.dead_threshold, self.cluster_size[0]))

    def _load_from_state_dict(self, *args: object, **kwargs: object) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._begun = False


def _nearest(z: Tensor, codes: Tensor) -> Tensor:
    """argmin_j |z - e_j| of latents (M, Z) and codes (K, Z): int64 (M,)."""
    squares = (z**2).sum(1)[:, None] + (codes**2).sum(1) - 2 * torch.einsum("id,jd->ij", z, codes)
    return squares.clamp(min=1e-8).sqrt().argmin(dim=1)


def _sample(rows: int, count: int, device: torch.device) -> Tensor:
    if rows >= count:
        return torch.randperm(rows, device=device)[:count]
    return torch.randint(0, rows, (count,), device=device)


class ActionQuantizer(nn.Module):
    """Prototype and code of latent actions.

    Args:
        decay: d, of the codebook's average.
        dead_threshold: n_k below which a code is revived; 0 revives none.
        commitment: beta.
    """

    def __init__(
        self, latent_dim: int, n_prototypes: int, decay: float, dead_threshold: float, commitment: float
    ) -> None:
        super().__init__()
        self.commitment = commitment
        codebook = EMACodebook(latent_dim, n_prototypes, decay, dead_threshold)
        self.vq = nn.ModuleDict({"_codebook": codebook})  # names of earlier checkpoints
        self._waiting: list[Tensor] = []

    @property
    def codebook(self) -> EMACodebook:
        """The codes and their averages."""
        return self.vq["_codebook"]  # type: ignore[return-value]

    @property
    def prototypes(self) -> Tensor:
        """The codebook (K, Z)."""
        return self.codebook.embed[0]

    @property
    def starts_from_a_batch(self) -> bool:
        """Whether the first global batch, which k-means starts from, is still to come."""
        return not self.codebook.begun

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quantise latent actions (..., Z).

        Returns:
            p (..., Z) with a straight-through gradient, code (...) int64, and the commitment loss (scalar, beta
            included; 0 in evaluation mode). In training mode the codebook is updated.
        """
        flat = z.reshape(-1, z.shape[-1])
        seen = flat.detach().float()
        if self.training and share().micros > 1:
            quantized, code = self._micro(seen)
        else:
            every = all_rows(seen) if self.training else seen
            quantized, code = self.codebook.quantize(every)
            if self.training:
                self.codebook.follow(every, code)
            if len(every) > len(seen):
                own = slice(here().rank * len(seen), (here().rank + 1) * len(seen))
                quantized, code = quantized[own], code[own]
        quantized = quantized.to(z.dtype)
        loss = self.commitment * F.mse_loss(quantized, flat) if self.training else z.new_zeros(())
        p = z + (quantized.reshape(z.shape) - z).detach()
        return p, code.reshape(z.shape[:-1]), loss

    def _micro(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Quantise a micro-batch (M, Z); after the last one the codebook starts from all of them, or moves."""
        own = share()
        if own.rehearsal:
            quantized, code = seen, seen.new_zeros(len(seen), dtype=torch.long)
        else:
            quantized, code = self.codebook.quantize(seen)
        self._waiting = [*self._waiting, seen] if own.micro else [seen]
        if own.micro == own.micros - 1:
            every, self._waiting = all_rows(torch.cat(self._waiting)), []
            self.codebook.start(every)
            if not own.rehearsal:
                self.codebook.follow(every, self.codebook.nearest(every))
        return quantized, code


def usage(code: Tensor, n_prototypes: int) -> tuple[Tensor, Tensor]:
    """Fraction of the codes in use, and perplexity exp(H) of their frequencies (1 to K), of the global batch."""
    counts = one_hot(all_rows(code.flatten()), n_prototypes).sum(0).float()
    frequency = counts / counts.sum().clamp(min=1)
    entropy = -(frequency * frequency.clamp(min=1e-12).log()).sum()
    return (counts > 0).float().mean(), entropy.exp()


def one_hot(code: Tensor, count: int) -> Tensor:
    """(...) int64 to booleans (..., K), without the look at the values that torch's takes."""
    return code[..., None] == torch.arange(count, device=code.device)
