"""The latent policy: z_t = f_pi(S_t), InvDyn_S's architecture with one head (paper, appendix A.4).

Shapes: slots (..., N, D) -> (..., Z). On real actions in place of latents it is the slot oracle. Of several tasks it is
told which: f_pi(S_t, e_k), a learned row e_k (D,) beside the slots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn

from playslot_rl.config import PolicyConfig
from playslot_rl.modules.action_range import ActionRange
from playslot_rl.modules.transformer import SlotTokenEncoder, chosen_slots
from playslot_rl.modules.whitening import Whitening


class Decides(Protocol):
    """A policy as an action decoder meets it; one of several tasks is told TASK (..., 1).

    Attributes:
        tasks: how many it is told apart; 0 for one.
    """

    tasks: int

    def features(self, observed: Tensor, *task: Tensor) -> Tensor:
        """What the decoder may read beside the latent action, (..., N, D), of what the policy observes."""

    @property
    def decide(self) -> Callable[..., Tensor]:
        """Latent actions (..., Z) from these."""


class LatentPolicy(nn.Module):
    """Latent action from the slots of one frame, or from some of them (`config.slots`).

    Note: the paper's policy sees all slots; what moves by itself says nothing of what to do (docs/results/tasks.md).
    With `whiten` the head gives whitened coordinates of the latent action, which is what is cloned
    (`behaviour.whiten`); the paper clones latents as they are.

    Args:
        out_dim: Z, or A for the oracle.
        whiten: have a `whitening`, to be fitted before training.
        acts: it gives real actions, and has their `action_range`.
        tasks: how many tasks it is told apart; 0 for one, of which nothing is said.

    Attributes:
        gain: of PlaySlot's actor (`acting.belief`).
    """

    def __init__(
        self,
        config: PolicyConfig,
        slot_dim: int,
        out_dim: int,
        whiten: bool = False,
        acts: bool = False,
        tasks: int = 0,
    ) -> None:
        super().__init__()
        c = config
        self.encoder = SlotTokenEncoder(slot_dim, c.dim, c.layers, c.heads, c.head_dim, c.mlp_dim)
        self.head = nn.Linear(c.dim, out_dim)
        self.whitening = Whitening(out_dim) if whiten else None
        if acts:
            self.action_range = ActionRange(out_dim)
        self.tasks, self.slots, self.gain = tasks, c.slots, c.gain
        self.told = nn.Embedding(tasks, slot_dim) if tasks else None

    def forward(self, slots: Tensor, task: Tensor | None = None) -> Tensor:
        """Slots (..., N, D), and the task int64 (..., 1) where it is told, to latent actions (..., Z)."""
        slots = chosen_slots(slots, self.slots)
        if self.told is not None:
            assert task is not None
            slots = torch.cat((slots, self.told(task)), dim=-2)
        out: Tensor = self.head(self.encoder(slots))
        return out if self.whitening is None else self.whitening.inverse(out)

    def features(self, observed: Tensor, *task: Tensor) -> Tensor:  # noqa: ARG002
        """The slots themselves."""
        return observed

    def decide(self, features: Tensor, *task: Tensor) -> Tensor:
        """Latent actions (..., Z)."""
        z: Tensor = self(features, *task)
        return z
