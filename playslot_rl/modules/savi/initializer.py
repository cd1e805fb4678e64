"""The initial slots S_0 (paper, appendix A.1).

gaussian:  S_0,n = mu + sigma * eps_n,  eps ~ N(0, I), mu and sigma learned and shared by all slots (paper)
learned:   S_0,n = mu_n, one learned vector per slot (SOLD)
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from playslot_rl.runtime.shares import own_noise


class SlotInitializer(nn.Module):
    """Initial slots of an episode.

    Args:
        n_slots: N.
        slot_dim: D.
        mode: `gaussian` or `learned`.
    """

    def __init__(self, n_slots: int, slot_dim: int, mode: Literal["gaussian", "learned"]) -> None:
        super().__init__()
        self.n_slots, self.slot_dim, self.mode = n_slots, slot_dim, mode
        rows = 1 if mode == "gaussian" else n_slots
        self.mean = nn.Parameter(torch.empty(rows, slot_dim))
        nn.init.xavier_uniform_(self.mean)
        if mode == "gaussian":
            self.log_scale = nn.Parameter(torch.empty(1, slot_dim))
            nn.init.xavier_uniform_(self.log_scale)

    def forward(self, batch: int, generator: torch.Generator | None = None) -> Tensor:
        """Initial slots (batch, N, D); `gaussian` draws them with the generator."""
        mean = self.mean.expand(self.n_slots, -1).expand(batch, -1, -1)
        if self.mode == "learned":
            return mean
        noise = own_noise(
            (batch, self.n_slots, self.slot_dim),
            lambda shape: torch.randn(shape, generator=generator, device=mean.device, dtype=mean.dtype),
        )
        return mean + self.log_scale.exp() * noise
