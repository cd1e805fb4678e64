"""SOLD's trained networks, by the sizes of its config. SAVi, which is frozen, is not among them."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from playslot_rl.baselines.sold.aggregation import SlotAggregation
from playslot_rl.baselines.sold.heads import ActorHead, ScalarHead
from playslot_rl.config import PredictorConfig
from playslot_rl.config.baselines import SOLDConfig
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq


class SOLDNetworks(nn.Module):
    """Dynamics, reward, critic and actor.

    Args:
        config: sizes.
        slot_dim: D.
        action_dim: A.
        frames: frames of the longest sequence that the dynamics learn from.
    """

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int, frames: int) -> None:
        super().__init__()
        c = config
        sizes = PredictorConfig(
            kind="ocvp_seq",
            dim=c.dim,
            layers=c.dynamics_layers,
            heads=c.heads,
            head_dim=c.dim // c.heads,
            mlp_dim=c.mlp_dim,
            residual=True,
            context=max(frames, c.context + c.horizon),
        )
        self.dynamics = OCVPSeq(sizes, slot_dim, action_dim)
        self.reward = ScalarHead(self._backbone(c, slot_dim), c.dim, c.bins, c.limit, c.mean)
        self.critic = ScalarHead(self._backbone(c, slot_dim), c.dim, c.bins, c.limit, c.mean)
        self.actor = ActorHead(self._backbone(c, slot_dim), c.dim, action_dim)

    @staticmethod
    def _backbone(c: SOLDConfig, slot_dim: int) -> SlotAggregation:
        return SlotAggregation(slot_dim, c.dim, c.head_layers, c.heads, c.mlp_dim)

    @property
    def parts(self) -> Mapping[str, nn.Module]:
        """By name, as checkpoints store them."""
        return {"dynamics": self.dynamics, "reward": self.reward, "critic": self.critic, "actor": self.actor}


def acting_window(config: SOLDConfig) -> int:
    """Frames the actor looks back when it acts.

    Note: C. In imagination its first decision follows 1 to C parsed frames and later ones follow predicted frames too;
    longer windows of parsed frames only are what it never saw.
    """
    return config.context
