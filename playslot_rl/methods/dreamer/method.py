"""DreamerV3 learns by acting, from pixels: the method, and its settings (`baselines.dreamer`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.machine import FLOAT, WEIGHT, Need, chain
from playslot_rl.config.methods import Load, Method, Style
from playslot_rl.config.plain import check
from playslot_rl.config.roles import (
    COUNT,
    LAYERS,
    NOT_NEGATIVE,
    OPEN_FRACTION,
    above_zero,
    at_least,
    between,
    role,
    was,
    within,
)
from playslot_rl.config.stage_spec import StageSpec
from playslot_rl.methods.online.config import SHARE, OnlineConfig


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
        compile_train_step: losses and gradients as compiled kernels; needs a GPU and a C++ compiler.
        cudagraph: losses and gradients as one CUDA graph; needs a GPU.
    """

    update_ratio: float = field(default=0.25, metadata=above_zero())
    group = "baselines.dreamer."
    within_episode = False  # as the source's stream of frames; `IS_FIRST` resets the state
    frame_size: int = field(default=0, metadata=at_least(0, "0 (the environment's) or pixels"))
    depth: int = field(default=16, metadata=COUNT)
    mults: tuple[int, ...] = field(default=(2, 3, 4, 4), metadata=COUNT)
    kernel: int = field(default=5, metadata=within(lambda value: value % 2 == 1, "an odd number, 1 to 31", 1, 31))
    belief: int = field(default=2048, metadata=COUNT)
    blocks: int = field(default=8, metadata=COUNT)
    categoricals: int = field(default=32, metadata=COUNT)
    classes: int = field(default=16, metadata=COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    units: int = field(default=256, metadata=COUNT)
    layers: int = field(default=3, metadata=LAYERS)
    lr: float = field(default=4e-5, metadata=at_least(0, "0 or more", 1e30))
    warmup: int = field(default=1000, metadata=NOT_NEGATIVE)
    reconstruction_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    free_nats: float = field(default=1.0, metadata=NOT_NEGATIVE)
    representation_weight: float = field(default=0.1, metadata=NOT_NEGATIVE)
    replay_value_weight: float = field(default=0.3, metadata=NOT_NEGATIVE)
    horizon: int = field(default=15, metadata=at_least(1))
    gamma: float = field(default=1 - 1 / 333, metadata=OPEN_FRACTION)
    lmbda: float = field(default=0.95, metadata=between(0, 1, "0 to 1"))
    entropy: float = field(default=3e-4, metadata=NOT_NEGATIVE)
    critic_rate: float = field(default=0.02, metadata=SHARE)
    compile_train_step: bool = field(default=False, metadata=role("free") | was(False))
    cudagraph: bool = field(default=False, metadata=role("free") | was(False))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(len(self.mults) > 0, "baselines.dreamer.mults", self.mults, "at least one")
        check(self.belief % self.blocks == 0, "belief", self.belief, f"a multiple of blocks ({self.blocks})")

    def needs(self, name: str, config: ExperimentConfig) -> Iterator[Need]:
        state, depths = self.categoricals * self.classes, [self.depth * mult for mult in self.mults]
        weights = self.kernel**2 * chain(3, *depths) + self.belief**2 / self.blocks
        weights += (self.hidden + self.units) * (self.belief + state) + 2 * self.layers * self.units**2
        yield Need((name,), "Dreamer's weights", weights * WEIGHT)
        side = self.frame_size or config.env.image_size
        yield from self.acting_needs(name, 3 * side**2, config.env.max_steps)
        imagined = self.horizon * self.batch_size * (self.belief + state)
        yield Need((f"{name}.horizon",), "imagined rollouts", imagined * FLOAT, host=False)


NAME: Final = "dreamer"
STAGE: Final = StageSpec(
    NAME,
    keys=("env",),
    settings=("baselines.dreamer",),
    begun=("render",),
    data="",
    parts="playslot_rl.methods.dreamer.learner:training",
)
DREAMER: Final = Method(
    NAME,
    ("DreamerV3",),
    Style(3, "D"),
    DreamerConfig,
    (STAGE,),
    Load(actor="playslot_rl.methods.dreamer.networks:load_actor"),
)
