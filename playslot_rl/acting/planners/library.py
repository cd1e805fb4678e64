"""Plans out of videos: windows of the latent actions that InvDyn infers in them, of which the cheapest is begun with.

    z^ = argmin_{c in C} J(c),   C: windows (z_t, ..., z_{t+H-1}) of videos, drawn anew at every decision

A search in latents alone finds futures that the model guesses and actions that the decoder guesses. What was done in a
video was done: model and decoder know it, and a latent action means the same in another place (`playslot inspect`,
transfer). No label is read.

Shapes: L windows, M of them tried, T transitions of an episode, H horizon, Z latent-action width. "[N,]" is there with
one latent action per slot.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from playslot_rl.acting.planners.planner import Cost


@dataclass(frozen=True)
class Library:
    """Windows of videos.

    Attributes:
        latents: (L, H, [N,] Z).
        tried: M, windows whose cost is computed at a decision.
    """

    latents: Tensor
    tried: int

    @torch.no_grad()
    def cheapest(self, cost: Cost, generator: torch.Generator) -> Tensor:
        """The cheapest (1, H, [N,] Z) of `tried` random windows.

        Args:
            cost: of plans from here; a window without a finite cost is not taken while there is another.
            generator: draws the windows.
        """
        order = torch.randperm(len(self.latents), generator=generator, device=generator.device)
        windows = self.latents[order[: self.tried]]
        costs = cost(windows)
        return windows[torch.where(costs.isfinite(), costs, torch.inf).argmin()][None]


def latent_windows(episodes: Iterable[Tensor], horizon: int) -> Tensor:
    """All windows (L, H, [N,] Z) of episodes' latent actions, each (T, [N,] Z).

    A window that ends after its episode goes on with zeros, "nothing moves"; those of which less than a quarter is
    left are not taken, unless the episode has no others.

    Examples:
        >>> latent_windows([torch.tensor([[1.0], [2.0], [3.0]])], 2)[..., 0].tolist()
        [[1.0, 2.0], [2.0, 3.0], [3.0, 0.0]]
    """
    found = []
    for latents in episodes:
        padded = torch.cat([latents, latents.new_zeros(horizon, *latents.shape[1:])])
        last = max(0, len(latents) - max(1, horizon // 4))
        found += [padded[begin : begin + horizon] for begin in range(last + 1)]
    return torch.stack(found)
