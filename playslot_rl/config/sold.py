"""Config of SOLD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from playslot_rl.config.online import OnlineConfig
from playslot_rl.config.plain import check


@dataclass(frozen=True)
class SOLDConfig(OnlineConfig):
    """Sizes and schedule of SOLD (Mosbach et al., 2025); the defaults are the source's where our references name them.

    Of `OnlineConfig`, `sequence` (18 frames: 3 of context and 15 predicted) differs, and so do the sizes of batches.
    Of a longer sequence (0: whole episodes) the dynamics and the reward learn from a window of C + H frames, drawn anew
    each time; imagination starts anywhere in it.

    Attributes:
        dim, heads, mlp_dim: token width, attention heads and hidden width of all four transformers.
        dynamics_layers: layers of OCVP-Seq, each one attention over objects and one over time.
        head_layers: layers of the slot-aggregation transformers of reward, value and actor.
        bins: categories of the two-hot heads, evenly spaced in symlog from -`limit` to `limit`.
        limit: the grid's ends, in symlog.
        mean: how a head's probabilities become a value, averaged in `symlog` or `linear` (see `heads.py`).
        context: frames (C) that a rollout starts from, at most: 1 to C are drawn. The actor acts on its last C frames.
        horizon: imagined steps (H).
        starts: imagined rollouts in an update, from frames drawn from its batch.
        gamma, lmbda: discount and lambda of the returns.
        entropy: weight of the policy's entropy.
        actor_gradient: `dynamics` (through the imagined rollout) or `reinforce`.
        return_rate: share of the new batch in the average of the returns' 5-95 percentile range.
        critic_decay: of the average of the critic's weights, which its loss pulls it towards.
        actor_average: of the average of the actor's weights, which is evaluated and saved; 0 takes the last weights.
        slot_weight, image_weight: weights of the dynamics' losses. With an image loss the replay keeps pixels too.
        decoded_frames: predicted frames decoded for the image loss, drawn at random; 0 decodes all of them.
        actor_lr, critic_lr, model_lr: Adam's rates; `model_lr` is that of dynamics and reward.
        grad_clip: maximum gradient norm of each of the four networks.
        world_model_updates: first updates that train dynamics and reward only.
        savi_steps: agent steps of the data that SAVi was trained on; None reads them from its checkpoint.
    """

    batch_size: int = 16
    sequence: int = 18
    dim: int = 256
    heads: int = 8
    mlp_dim: int = 512
    dynamics_layers: int = 4
    head_layers: int = 3
    bins: int = 255
    limit: float = 20.0
    mean: Literal["symlog", "linear"] = "symlog"
    context: int = 3
    horizon: int = 15
    starts: int = 256
    gamma: float = 0.96
    lmbda: float = 0.95
    entropy: float = 3e-4
    actor_gradient: Literal["dynamics", "reinforce"] = "dynamics"
    return_rate: float = 0.01
    critic_decay: float = 0.98
    actor_average: float = 0.0
    slot_weight: float = 1.0
    image_weight: float = 1.0
    decoded_frames: int = 0
    actor_lr: float = 3e-5
    critic_lr: float = 3e-5
    model_lr: float = 1e-4
    grad_clip: float = 10.0
    world_model_updates: int = 0
    savi_steps: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        group = "baselines.sold"
        check(self.dim % self.heads == 0, f"{group}.heads", self.heads, f"a divisor of {group}.dim={self.dim}")
        check(self.context >= 1, f"{group}.context", self.context, "at least 1")
        check(self.horizon >= 1, f"{group}.horizon", self.horizon, "at least 1")
        check(self.starts >= 1, f"{group}.starts", self.starts, "at least 1")
        check(self.bins >= 3 and self.bins % 2 == 1, f"{group}.bins", self.bins, "an odd number from 3 on")
        check(self.limit > 0, f"{group}.limit", self.limit, "above 0")
        longer = self.sequence == 0 or self.sequence > self.context
        check(longer, f"{group}.sequence", self.sequence, f"0, or more than {group}.context={self.context}")
        for name in ("gamma", "lmbda", "critic_decay", "actor_average", "return_rate"):
            check(0 <= getattr(self, name) <= 1, f"{group}.{name}", getattr(self, name), "a number in [0, 1]")
        learns = self.slot_weight + self.image_weight > 0 and min(self.slot_weight, self.image_weight) >= 0
        check(learns, f"{group}.slot_weight", self.slot_weight, "slot_weight or image_weight above 0, none below")
        check(self.savi_steps is None or self.savi_steps >= 0, f"{group}.savi_steps", self.savi_steps, "0 or more")
