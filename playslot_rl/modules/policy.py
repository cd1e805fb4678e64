"""The latent policy: z_t = f_pi(S_t), InvDyn_S's architecture with one head (paper, appendix A.4).

Shapes: slots (..., N, D) -> (..., Z). On real actions in place of latents it is the slot oracle. It can be told what to
do: which of several tasks, f_pi(S_t, e_k), a learned row e_k (D,) beside the slots; or where to get, f_pi([S_t, G]),
each slot beside the same one in a goal image.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn

from playslot_rl import keys
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

    def features(self, observed: Tensor, *told: Tensor) -> Tensor:
        """What the decoder may read beside the latent action, (..., N, D), of what the policy observes."""

    @property
    def decide(self) -> Callable[..., Tensor]:
        """Latent actions (..., Z) from these."""


def told_keys(policy: object) -> list[str]:
    """What a policy is told beside what it observes: GOAL_SLOTS, or TASK, or nothing."""
    if getattr(policy, "goal", False):
        return [keys.GOAL_SLOTS]
    return [keys.TASK] if getattr(policy, "tasks", 0) else []


class LatentPolicy(nn.Module):
    """Latent action from the slots of one frame, or from some of them (`config.slots`).

    Note: the paper's policy sees all slots; what moves by itself says nothing of what to do (docs/results/tasks.md).
    With `whiten` the head gives whitened coordinates of the latent action, which is what is cloned
    (`behaviour.whiten`); the paper clones latents as they are. The paper's policy is told nothing; goal images are
    those in which demonstrations end (`config.goal`).

    Args:
        out_dim: Z, or A for the oracle.
        whiten: have a `whitening`, to be fitted before training.
        acts: it gives real actions, and has their `action_range`.
        tasks: how many tasks it is told apart, unless by goal images; 0 for one, of which nothing is said.

    Attributes:
        gain: of PlaySlot's actor (`acting.belief`).
        goal: whether it is told the slots of a goal image.
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
        width = 2 * slot_dim if c.goal else slot_dim
        self.encoder = SlotTokenEncoder(width, c.dim, c.layers, c.heads, c.head_dim, c.mlp_dim)
        self.head = nn.Linear(c.dim, out_dim)
        self.whitening = Whitening(out_dim) if whiten else None
        if acts:
            self.action_range = ActionRange(out_dim)
        self.tasks, self.slots, self.gain, self.goal = 0 if c.goal else tasks, c.slots, c.gain, c.goal
        self.told = nn.Embedding(tasks, slot_dim) if self.tasks else None

    def forward(self, slots: Tensor, told: Tensor | None = None) -> Tensor:
        """Slots (..., N, D), and the task int64 (..., 1) or the goal's slots (..., N, D) where it is told, to latent
        actions (..., Z).
        """
        if self.goal:
            assert told is not None
            slots = torch.cat((slots, told), dim=-1)
        slots = chosen_slots(slots, self.slots)
        if self.told is not None:
            assert told is not None
            slots = torch.cat((slots, self.told(told)), dim=-2)
        out: Tensor = self.head(self.encoder(slots))
        return out if self.whitening is None else self.whitening.inverse(out)

    def features(self, observed: Tensor, *told: Tensor) -> Tensor:  # noqa: ARG002
        """The slots themselves."""
        return observed

    def decide(self, features: Tensor, *told: Tensor) -> Tensor:
        """Latent actions (..., Z)."""
        z: Tensor = self(features, *told)
        return z
