"""Config of the baselines (the group `baselines` of the experiment's config), one class a method.

The slot oracle has none: its sizes are `model.policy`, its schedule is `behaviour`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.plain import check
from playslot_rl.config.roles import (
    COUNT,
    LAYERS,
    NOT_NEGATIVE,
    OPEN_FRACTION,
    RATE,
    YEAR_MINUTES,
    Checked,
    above_zero,
    at_least,
    between,
    role,
    was,
    within,
)
from playslot_rl.config.stages import OptimConfig, StageConfig
from playslot_rl.config.video import CADDYConfig, OCVPSeqConfig, SlotFormerConfig, SVGConfig

SHARE = between(0, 1, "a number in [0, 1]")
SEQUENCE = within(lambda value: value != 1, "0 (whole episodes), or at least 2")


@dataclass(frozen=True)
class ResNetOracleConfig(StageConfig):
    """Schedule of the ResNet oracle; the head's sizes are `model.policy`, its loss `behaviour.loss`.

    Attributes:
        weights: of ResNet-18: `auto` (ImageNet's from torchvision's cache, from scratch where they are not there),
            `scratch`, `download` (ImageNet's, fetched if they are not in the cache), or the path of a file of them
            (`.pth` as torchvision publishes it, or `.safetensors` with the same names).
        shift: frames are shifted by up to so many pixels either way in training, edges repeated; 0 does not.
        patience: end before `steps` once the error on held-out demonstrations has not fallen for so many validations,
            with the weights that had the lowest; 0, or none held out: train all steps.
    """

    group = "baselines.resnet_oracle."
    steps: int = field(default=20_000, metadata=at_least(1))
    batch_size: int = field(default=64, metadata=at_least(1))
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=2e-4, warmup_steps=0, schedule="constant", grad_clip=0.0)
    )
    weights: str = "auto"
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    patience: int = field(default=0, metadata=was(0) | at_least(0))


def _stage(steps: int, lr: float, schedule: Literal["cosine", "constant"]) -> StageConfig:
    return StageConfig(
        steps=steps, batch_size=64, optim=OptimConfig(lr=lr, warmup_steps=0, schedule=schedule, grad_clip=1.0)
    )


@dataclass(frozen=True)
class LAPOConfig(Checked):
    """Sizes and schedule of LAPO. The action decoder's size is `model.action_decoder`, its inputs
    `behaviour.decoder_inputs`, its labels `behaviour.labelled_demos`: as for PlaySlot.

    Attributes:
        channels: of the convolutional encoders; each halves the resolution.
        hidden: width of the layer between an encoder and its output.
        groups: G codes that make up a latent action.
        code_dim: width of each, so that a latent action has `groups * code_dim` numbers.
        codes: K entries of the codebook, which the groups share.
        decay: of the codebook's moving average.
        dead_threshold: EMA cluster size under which a code is revived.
        commitment: weight beta of the commitment term.
        loss: of the latent policy and the action decoder: `l2` or `l1`.
        targets: latents that the policy clones and the decoder reads, `quantised` or `continuous` (before they are).
        shift: shift of frames in the latent policy's training, pixels.
        model: training of inverse and forward model.
        policy: training of the latent policy.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest is as for the policy.
        world: another run of LAPO whose inverse and forward model are taken; empty trains them on `data.root`.
    """

    group = "baselines.lapo."
    channels: tuple[int, ...] = field(default=(64, 128, 128), metadata=COUNT)
    hidden: int = field(default=256, metadata=COUNT)
    groups: int = field(default=8, metadata=at_least(1))
    code_dim: int = field(default=16, metadata=COUNT)
    codes: int = field(default=64, metadata=at_least(2))
    decay: float = field(default=0.99, metadata=OPEN_FRACTION)
    dead_threshold: float = field(default=1.0, metadata=NOT_NEGATIVE)
    commitment: float = field(default=0.05, metadata=NOT_NEGATIVE)
    loss: Literal["l2", "l1"] = "l2"
    targets: Literal["quantised", "continuous"] = field(default="quantised", metadata=was("quantised"))
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    model: StageConfig = field(default_factory=lambda: _stage(200_000, 3e-4, "cosine"))
    policy: StageConfig = field(default_factory=lambda: _stage(20_000, 2e-4, "constant"))
    decoder_steps: int = field(default=20_000, metadata=at_least(1))
    decoder_lr: float = field(default=2e-4, metadata=RATE)
    world: str = field(default="", metadata=role("machine", "folder"))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(1 <= len(self.channels) <= 5, "baselines.lapo.channels", self.channels, "1 to 5 widths")

    @property
    def latent_dim(self) -> int:
        """Z = G times the width of a code."""
        return self.groups * self.code_dim


@dataclass(frozen=True)
class CADDYPolicyConfig(Checked):
    """Schedule of CADDY's policy; its model is `baselines.caddy`. The action decoder's size is `model.action_decoder`,
    its inputs, loss and labels are `behaviour`'s, as for PlaySlot.

    Attributes:
        shift: shift of frames in the policy's training, pixels.
        policy: training of the policy.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest is as for the policy.
        world: run whose CADDY is taken; empty trains one on `data.root`.
    """

    group = "baselines.caddy_policy."
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    policy: StageConfig = field(default_factory=lambda: _stage(20_000, 2e-4, "constant"))
    decoder_steps: int = field(default=20_000, metadata=at_least(1))
    decoder_lr: float = field(default=2e-4, metadata=RATE)
    world: str = field(default="", metadata=role("machine", "folder"))


@dataclass(frozen=True)
class CADDYOracleConfig(Checked):
    """Schedule of the CADDY Oracle; its model is `baselines.caddy`, its loss `behaviour.loss`.

    Attributes:
        shift: shift of frames in training, pixels.
        policy: its training.
        world: run whose CADDY is taken; empty trains one on `data.root`.
    """

    group = "baselines.caddy_oracle."
    shift: int = field(default=0, metadata=between(0, 16, "0 to 16 pixels"))
    policy: StageConfig = field(default_factory=lambda: _stage(20_000, 2e-4, "constant"))
    world: str = field(default="", metadata=role("machine", "folder"))


@dataclass(frozen=True)
class OnlineConfig(Checked):
    """Acting, replay and schedule of a method that learns by acting.

    A step is an agent step: `env.frame_skip` environment steps of the same action.

    Attributes:
        steps: agent steps in all, those of the random start too.
        minutes: wall-clock budget over all processes; 0 means none. Training then ends at the round that crosses it,
            so that how far it got depends on the machine.
        prefill: agent steps of uniformly random actions before the first update.
        envs: episodes played side by side, a round: the policy changes between rounds only.
        workers: processes that play the rounds while this one learns, each `envs / workers` episodes, with weights that
            are one round old; 0 plays them in this process, between its updates, with the newest ones.
        update_ratio: updates for each agent step.
        batch_size: sequences in an update (B).
        sequence: frames in a sequence (T); 0 means whole episodes. Sequences longer than an episode run across
            episodes, shorter ones stay within one.
        reward_scale: rewards are multiplied by it before the method learns from them; the curve's returns are not.
            Grids of values and the least range of returns that is divided by (1) suit rewards of the order of 1 to 10.
        capacity: frames that the replay keeps; the oldest episodes go first.
        replay_on_disk: memory-map the replay, where it does not fit into memory.
        evaluate_every: agent steps between points of the learning curve.
        evaluation_episodes: development episodes for a point.
        checkpoint_every: agent steps between checkpoints.
        log_every: updates between lines of `metrics.jsonl`.
    """

    steps: int = field(default=1_000_000, metadata=at_least(1))
    minutes: float = field(default=0.0, metadata=role("free") | at_least(0, largest=YEAR_MINUTES))
    prefill: int = field(default=1000, metadata=at_least(1))
    envs: int = field(default=1, metadata=at_least(1, largest=1024))
    workers: int = field(default=0, metadata=was(0) | at_least(0, largest=1024))
    update_ratio: float = field(default=0.5, metadata=above_zero())
    batch_size: int = field(default=16, metadata=at_least(1))
    sequence: int = field(default=64, metadata=SEQUENCE)
    reward_scale: float = field(default=1.0, metadata=was(1.0) | above_zero())
    capacity: int = field(default=1_000_000, metadata=at_least(1))
    replay_on_disk: bool = field(default=False, metadata=role("free"))
    evaluate_every: int = field(default=10_000, metadata=role("free") | at_least(1))
    evaluation_episodes: int = field(default=20, metadata=at_least(1))
    checkpoint_every: int = field(default=10_000, metadata=role("free") | at_least(1))
    log_every: int = field(default=100, metadata=role("free") | at_least(1))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.prefill <= self.steps, "prefill", self.prefill, f"at most steps ({self.steps})")
        divided = self.workers == 0 or self.envs % self.workers == 0
        check(divided, "workers", self.workers, f"0 or a divisor of envs ({self.envs})")


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

    update_ratio: float = field(default=0.25, metadata=above_zero())
    group = "baselines.dreamer."
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

    def __post_init__(self) -> None:
        super().__post_init__()
        check(len(self.mults) > 0, "baselines.dreamer.mults", self.mults, "at least one")
        check(self.belief % self.blocks == 0, "belief", self.belief, f"a multiple of blocks ({self.blocks})")


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
        mean: how a head's probabilities become a value, averaged in `symlog` or `linear` (see `networks.py`).
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

    group = "baselines.sold."
    batch_size: int = field(default=16, metadata=at_least(1))
    sequence: int = field(default=18, metadata=SEQUENCE)
    dim: int = field(default=256, metadata=COUNT)
    heads: int = field(default=8, metadata=COUNT)
    mlp_dim: int = field(default=512, metadata=COUNT)
    dynamics_layers: int = field(default=4, metadata=LAYERS)
    head_layers: int = field(default=3, metadata=LAYERS)
    bins: int = field(default=255, metadata=within(lambda value: value % 2 == 1, "an odd number from 3 on", 3))
    limit: float = field(default=20.0, metadata=above_zero())
    mean: Literal["symlog", "linear"] = "symlog"
    context: int = field(default=3, metadata=at_least(1))
    horizon: int = field(default=15, metadata=at_least(1))
    starts: int = field(default=256, metadata=at_least(1))
    gamma: float = field(default=0.96, metadata=SHARE)
    lmbda: float = field(default=0.95, metadata=SHARE)
    entropy: float = field(default=3e-4, metadata=NOT_NEGATIVE)
    actor_gradient: Literal["dynamics", "reinforce"] = "dynamics"
    return_rate: float = field(default=0.01, metadata=SHARE)
    critic_decay: float = field(default=0.98, metadata=SHARE)
    actor_average: float = field(default=0.0, metadata=was(0.0) | SHARE)
    slot_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    image_weight: float = field(default=1.0, metadata=NOT_NEGATIVE)
    decoded_frames: int = field(default=0, metadata=NOT_NEGATIVE)
    actor_lr: float = field(default=3e-5, metadata=at_least(0, "0 or more", 1e30))
    critic_lr: float = field(default=3e-5, metadata=at_least(0, "0 or more", 1e30))
    model_lr: float = field(default=1e-4, metadata=at_least(0, "0 or more", 1e30))
    grad_clip: float = field(default=10.0, metadata=NOT_NEGATIVE)
    world_model_updates: int = field(default=0, metadata=NOT_NEGATIVE)
    savi_steps: int | None = field(default=None, metadata=at_least(0, "0 or more"))

    def __post_init__(self) -> None:
        super().__post_init__()
        group = self.group
        check(self.dim % self.heads == 0, f"{group}heads", self.heads, f"a divisor of {group}dim={self.dim}")
        longer = self.sequence == 0 or self.sequence > self.context
        check(longer, f"{group}sequence", self.sequence, f"0, or more than {group}context={self.context}")
        learns = self.slot_weight + self.image_weight > 0 and min(self.slot_weight, self.image_weight) >= 0
        check(learns, f"{group}slot_weight", self.slot_weight, "slot_weight or image_weight above 0, none below")


@dataclass(frozen=True)
class BaselinesConfig:
    """Sizes and schedules, one group a method."""

    resnet_oracle: ResNetOracleConfig = field(default_factory=ResNetOracleConfig)
    lapo: LAPOConfig = field(default_factory=LAPOConfig)
    dreamer: DreamerConfig = field(default_factory=DreamerConfig)
    sold: SOLDConfig = field(default_factory=SOLDConfig)
    svg: SVGConfig = field(default_factory=SVGConfig)
    caddy: CADDYConfig = field(default_factory=CADDYConfig)
    caddy_policy: CADDYPolicyConfig = field(default_factory=CADDYPolicyConfig)
    caddy_oracle: CADDYOracleConfig = field(default_factory=CADDYOracleConfig)
    slotformer: SlotFormerConfig = field(default_factory=SlotFormerConfig)
    ocvp_seq: OCVPSeqConfig = field(default_factory=OCVPSeqConfig)
