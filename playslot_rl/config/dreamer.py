"""Config of DreamerV3."""

from __future__ import annotations

from dataclasses import dataclass

from playslot_rl.config.online import OnlineConfig
from playslot_rl.config.plain import check


@dataclass(frozen=True)
class DreamerConfig(OnlineConfig):
    """Sizes and schedule of DreamerV3 (Hafner et al. 2023); the defaults are its size of 12 M parameters.

    Attributes:
        frame_size: side of the frames it sees, pixels; smaller than `env.image_size` by a whole factor, averaged.
            0 means `env.image_size`.
        depth, mults: channels of the encoder's stages, `depth` times each of `mults`; each stage halves the frame.
        kernel: side of the convolutions.
        belief: width of the recurrent state h.
        blocks: blocks of the recurrent core.
        categoricals, classes: the stochastic state z: that many one-hot variables of that many classes.
        hidden: width of the RSSM's hidden layers.
        units: width of the heads' hidden layers.
        layers: hidden layers of actor and critic; the reward head has one.
        lr: learning rate of the one optimiser.
        warmup: updates of its linear warm-up.
        reconstruction_weight: of the image loss (a sum over pixels).
        free_nats: below which the KL terms do not push.
        representation_weight: of the KL term that trains the posterior; the prior's weighs 1.
        replay_value_weight: of the critic's loss on replayed rewards, which also trains the representation.
        horizon: steps imagined.
        gamma: discount; 1 - 1/333 in the source.
        lmbda: of the lambda returns.
        entropy: weight of the actor's entropy.
        critic_rate: of the slow critic's moving average.
    """

    update_ratio: float = 0.25
    frame_size: int = 0
    depth: int = 16
    mults: tuple[int, ...] = (2, 3, 4, 4)
    kernel: int = 5
    belief: int = 2048
    blocks: int = 8
    categoricals: int = 32
    classes: int = 16
    hidden: int = 256
    units: int = 256
    layers: int = 3
    lr: float = 4e-5
    warmup: int = 1000
    reconstruction_weight: float = 1.0
    free_nats: float = 1.0
    representation_weight: float = 0.1
    replay_value_weight: float = 0.3
    horizon: int = 15
    gamma: float = 1 - 1 / 333
    lmbda: float = 0.95
    entropy: float = 3e-4
    critic_rate: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.belief % self.blocks == 0, "belief", self.belief, f"a multiple of blocks ({self.blocks})")
        check(0 < self.gamma < 1, "gamma", self.gamma, "between 0 and 1")
        check(0 <= self.lmbda <= 1, "lmbda", self.lmbda, "0 to 1")
        check(self.horizon >= 1, "horizon", self.horizon, "at least 1")
        check(self.frame_size >= 0, "frame_size", self.frame_size, "0 (the environment's) or pixels")
