"""SOLD learns by acting, on the slots of a finished SAVi: the method, and its settings (`baselines.sold`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import FLOAT, WEIGHT, Need
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import COUNT, LAYERS, NOT_NEGATIVE, above_zero, at_least, was, within
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.errors import ConfigError
from playslot_rl.methods.online.config import SEQUENCE, SHARE, OnlineConfig


@dataclass(frozen=True)
class SOLDConfig(OnlineConfig):
    """Sizes and schedule of SOLD (Mosbach et al., 2025); the defaults are the source's.

    Of a longer sequence (0: whole episodes) the dynamics and the reward learn from a window of C + H frames, drawn anew
    each time; imagination starts anywhere in it.

    Attributes:
        dim, heads, mlp_dim: sizes of all four transformers.
        dynamics_layers: layers of OCVP-Seq, each one attention over objects and one over time.
        head_layers: layers of the slot-aggregation transformers of reward, value and actor.
        bins: categories of the two-hot heads, evenly spaced in symlog from -`limit` to `limit`.
        limit: the grid's ends, in symlog.
        mean: how a head's probabilities become a value, averaged in `symlog` or `linear` (see `networks.py`).
        context: frames (C) that a rollout starts from, at most.
        least_context: at least; their number is drawn.
        horizon: predicted and imagined steps (H).
        starts: imagined rollouts in an update, from frames drawn from its batch.
        gamma, lmbda: discount and lambda of the returns.
        entropy: weight of the policy's entropy.
        actor_gradient: `dynamics` (through the imagined rollout) or `reinforce`.
        return_rate: share of the new batch in the average of the returns' 5-95 percentile range.
        critic_decay: of the average of the critic's weights, which its loss pulls it towards.
        slow_weight: of that pull; the returns weigh 1.
        actor_average: of the average of the actor's weights, which is evaluated and saved; 0 takes the last weights.
        slot_weight, image_weight: weights of the dynamics' losses. With an image loss the replay keeps pixels too.
        decoded_frames: frames of a sequence, drawn at random, that the image loss decodes; 0 decodes all.
        predicted_rewards: the reward head learns from predicted slots, too.
        actor_lr, critic_lr, model_lr: Adam's rates (`model_lr`: dynamics and reward).
        grad_clip: maximum gradient norm of reward, critic and actor.
        dynamics_clip: of the dynamics.
        world_model_updates: first updates that train dynamics and reward only.
        savi_steps: agent steps of the data that SAVi was trained on; None reads them from its checkpoint.
    """

    group = "baselines.sold."
    prefill: int = field(default=250, metadata=at_least(1))
    update_ratio: float = field(default=0.08, metadata=above_zero())
    batch_size: int = field(default=8, metadata=at_least(1))
    sequence: int = field(default=18, metadata=SEQUENCE)
    capacity: int = field(default=1_250_000, metadata=at_least(1))
    dim: int = field(default=256, metadata=COUNT)
    heads: int = field(default=8, metadata=COUNT)
    mlp_dim: int = field(default=512, metadata=COUNT)
    dynamics_layers: int = field(default=4, metadata=LAYERS)
    head_layers: int = field(default=3, metadata=LAYERS)
    bins: int = field(default=255, metadata=within(lambda value: value % 2 == 1, "an odd number from 3 on", 3))
    limit: float = field(default=20.0, metadata=above_zero())
    mean: Literal["symlog", "linear"] = "symlog"
    context: int = field(default=3, metadata=at_least(1))
    least_context: int = field(default=3, metadata=at_least(1))
    horizon: int = field(default=15, metadata=at_least(1))
    starts: int = field(default=8, metadata=at_least(1))
    gamma: float = field(default=0.96, metadata=SHARE)
    lmbda: float = field(default=0.95, metadata=SHARE)
    entropy: float = field(default=3e-4, metadata=NOT_NEGATIVE)
    actor_gradient: Literal["dynamics", "reinforce"] = "dynamics"
    return_rate: float = field(default=0.01, metadata=SHARE)
    critic_decay: float = field(default=0.98, metadata=SHARE)
    slow_weight: float = field(default=0.1, metadata=NOT_NEGATIVE)
    actor_average: float = field(default=0.0, metadata=was(0.0) | SHARE)
    slot_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    image_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    decoded_frames: int = field(default=0, metadata=NOT_NEGATIVE)
    predicted_rewards: bool = False
    actor_lr: float = field(default=3e-5, metadata=at_least(0, "0 or more", 1e30))
    critic_lr: float = field(default=3e-5, metadata=at_least(0, "0 or more", 1e30))
    model_lr: float = field(default=1e-4, metadata=at_least(0, "0 or more", 1e30))
    grad_clip: float = field(default=10.0, metadata=NOT_NEGATIVE)
    dynamics_clip: float = field(default=3.0, metadata=NOT_NEGATIVE)
    world_model_updates: int = field(default=0, metadata=NOT_NEGATIVE)
    savi_steps: int | None = field(default=None, metadata=at_least(0, "0 or more"))

    def __post_init__(self) -> None:
        super().__post_init__()
        group = self.group
        check(self.dim % self.heads == 0, f"{group}heads", self.heads, f"a divisor of {group}dim={self.dim}")
        longer = self.sequence == 0 or self.sequence > self.context
        check(longer, f"{group}sequence", self.sequence, f"0, or more than {group}context={self.context}")
        fits = self.least_context <= self.context
        check(fits, f"{group}least_context", self.least_context, f"at most {group}context={self.context}")
        learns = self.slot_weight + self.image_weight > 0 and min(self.slot_weight, self.image_weight) >= 0
        check(learns, f"{group}slot_weight", self.slot_weight, "slot_weight or image_weight above 0, none below")

    def check(self, name: str, config: ExperimentConfig) -> None:
        """Refuse, by a ConfigError, a context that a sequence across episodes may not hold of any one episode."""
        frames = config.env.max_steps + 1
        most = min(frames, (self.sequence + 1) // 2)
        if self.sequence > frames and self.context > most:
            raise ConfigError(
                f"{name}.context: got {self.context}, expected at most {most}, which every sequence of {self.sequence} "
                f"frames has of one episode of {frames}: lower it, or set {name}.sequence=0"
            )

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        slots = config.model.savi.n_slots * config.model.savi.slot_dim
        layers = self.dynamics_layers + 3 * self.head_layers
        weights = layers * (4 * self.dim**2 + 2 * self.dim * self.mlp_dim)
        weights += self.mlp_dim * (3 * self.dim + 2 * self.bins + 2 * config.env.action_dim)
        yield Need((name,), "SOLD's weights", weights * WEIGHT)
        pixels = 3 * config.env.image_size**2 if self.image_weight > 0 else 0
        yield from self.acting_needs(name, slots * FLOAT + pixels, config.env.max_steps)
        keys = (f"{name}.starts", f"{name}.horizon")
        yield Need(keys, "imagined rollouts", self.starts * self.horizon * slots * FLOAT, host=False)


NAME: Final = "sold"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.sold",),
    begun=("render",),
    parents=("slots",),
    data="",
    parts="playslot_rl.methods.sold.learner:training",
)
SOLD: Final = Method(
    NAME, ("SOLD",), Style(4, "P"), SOLDConfig, (STAGE,), Load(actor="playslot_rl.methods.sold.acting:load_actor")
)
