"""The configuration: frozen dataclasses are the truth, YAML and command-line overrides only change their values.

`from_dict` builds a config from nested plain dicts (what Hydra composes) and refuses unknown keys;
`to_dict` is its inverse; `fingerprint` names a config by its content (all three: `playslot_rl.plain`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.plain import fingerprint as fingerprint
from playslot_rl.plain import from_dict as from_dict
from playslot_rl.plain import to_dict as to_dict

LatentMode = Literal["hybrid", "discrete", "continuous", "ground_truth"]
Precision = Literal["fp32", "bf16"]


def _check(ok: bool, what: str, got: object, expected: str) -> None:
    if not ok:
        raise ValueError(f"{what}: got {got!r}, expected {expected}")


@dataclass(frozen=True)
class RenderConfig:
    """How frames are rendered, for data and for evaluation alike.

    Attributes:
        quality: `fast` (no shadows, no multisampling, box-averaged supersampling) or `full` (MuJoCo's default look).
        supersample: side factor of the `fast` path; 2 renders at twice the size and averages 2x2 boxes.
    """

    quality: Literal["fast", "full"] = "fast"
    supersample: int = 2

    def __post_init__(self) -> None:
        _check(1 <= self.supersample <= 8, "render.supersample", self.supersample, "an integer from 1 to 8")


@dataclass(frozen=True)
class GridConfig:
    """GridShapes, read by `env=grid_shapes` only.

    Attributes:
        objects: shapes in a clip, 1 to 5; `action_dim` is twice that.
        size: side of a shape, pixels.
        speed: pixels a step.
        change: probability that a shape draws a new direction at a step.
    """

    objects: int = 2
    size: int = 15
    speed: int = 2
    change: float = 0.25

    def __post_init__(self) -> None:
        _check(1 <= self.objects <= 5, "env.grid.objects", self.objects, "1 to 5")
        _check(self.size >= 3, "env.grid.size", self.size, "at least 3 pixels")
        _check(self.speed >= 1, "env.grid.speed", self.speed, "at least 1 pixel")
        _check(0.0 <= self.change <= 1.0, "env.grid.change", self.change, "a probability")


@dataclass(frozen=True)
class BlocksConfig:
    """The blocks family, read by `env=block_push`, `block_push_easy`, `block_reach` and `block_pick` only.

    Attributes:
        task: which object: `red`, `reddest` (nearest to red by CIEDE2000), `odd` (all others share another colour) or
            `odd_groups` (the others form groups of a colour).
        distractors: other objects, 0 to 4.
        distractors_to: where given, each episode draws their number from `distractors` to this.
        colour: colour of the odd object (a name in `playslot_rl.envs.colours`); empty draws it for each episode.
        reward: `dense` or `sparse`.
    """

    task: Literal["red", "reddest", "odd", "odd_groups"] = "odd"
    distractors: int = 3
    distractors_to: int | None = None
    colour: str = ""
    reward: Literal["dense", "sparse"] = "dense"

    def __post_init__(self) -> None:
        _check(0 <= self.distractors <= 4, "env.blocks.distractors", self.distractors, "0 to 4")
        last = self.distractors if self.distractors_to is None else self.distractors_to
        limits = f"{self.distractors} (env.blocks.distractors) to 4, or null"
        _check(self.distractors <= last <= 4, "env.blocks.distractors_to", last, limits)
        if self.colour:
            from playslot_rl.envs.colours import COLOURS

            _check(self.colour in COLOURS, "env.blocks.colour", self.colour, f"one of {', '.join(COLOURS)}")
            odd = self.task in ("odd", "odd_groups")
            _check(odd, "env.blocks.colour", self.colour, f"no colour with env.blocks.task={self.task}")


@dataclass(frozen=True)
class EnvConfig:
    """The task.

    Attributes:
        name: environment name (`button_press`, `block_push`, `grid_shapes`, ...).
        image_size: side of the square frames, pixels.
        action_dim: width A of the real action.
        frame_skip: environment steps per agent step, all with the same action.
        max_steps: agent steps in an episode.
        warmup_steps: random agent steps after each reset, before the first observation.
        grid: settings of `grid_shapes`.
        blocks: settings of the `block_*` environments.
    """

    name: str = "button_press"
    image_size: int = 64
    action_dim: int = 4
    frame_skip: int = 5
    max_steps: int = 20
    warmup_steps: int = 12
    grid: GridConfig = field(default_factory=GridConfig)
    blocks: BlocksConfig = field(default_factory=BlocksConfig)

    def __post_init__(self) -> None:
        _check(self.image_size in (32, 64, 128), "env.image_size", self.image_size, "32, 64 or 128")
        _check(self.frame_skip >= 1, "env.frame_skip", self.frame_skip, "at least 1")
        _check(self.max_steps >= 2, "env.max_steps", self.max_steps, "at least 2")
        used = self.name.startswith("block_") or self.blocks == BlocksConfig()
        _check(used, "env.blocks", self.blocks, f"no changes with env.name={self.name}, which has no blocks")


@dataclass(frozen=True)
class DataConfig:
    """Where data come from.

    Attributes:
        root: LeRobot v3.0 data set(s) of unlabelled videos; several are separated by commas.
        demos: data set of demonstrations; empty means `root`.
        camera: image feature(s) to read, separated by commas; empty means the only one.
        resize: resize frames of another size than `env.image_size` (area averaging) instead of refusing them.
        cache: folder of the frame and slot caches; empty means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`.
        validation: fraction of episodes held out from training.
    """

    root: str = ""
    demos: str = ""
    camera: str = ""
    resize: bool = False
    cache: str = ""
    validation: float = 0.05

    def __post_init__(self) -> None:
        _check(0.0 <= self.validation < 1.0, "data.validation", self.validation, "a fraction in [0, 1)")


@dataclass(frozen=True)
class CollectConfig:
    """What the collectors record (agent steps; an episode has one more frame than actions).

    Attributes:
        random_episodes: episodes of the random policy that `pipeline` collects.
        random_steps: agent steps of each.
        expert_episodes: demonstrations that `pipeline` collects for the policy.
        expert_steps: agent steps of each; clips go on past success.
        noise: standard deviation of Gaussian noise added to the expert's actions.
        noisy_episodes: episodes of the noisy expert that `pipeline` adds to the world model's videos.
        exploration_noise: standard deviation of its noise.
        learn_from_demos: whether the world model learns from the demonstrations' videos too (never their actions).
        storage: `image` (PNG in parquet, lossless) or `video` (h264 yuv444p, crf 0).
    """

    random_episodes: int = 400
    random_steps: int = 20
    expert_episodes: int = 150
    expert_steps: int = 20
    noise: float = 0.0
    noisy_episodes: int = 0
    exploration_noise: float = 0.5
    learn_from_demos: bool = False
    storage: Literal["image", "video"] = "image"


@dataclass(frozen=True)
class CollectorConfig:
    """How episodes are recorded, never what: the data do not depend on it.

    Attributes:
        backend: `local` processes of this machine, or actors of a `ray` cluster.
        timeout_s: seconds without an episode after which a worker counts as hanging and is started again.
        restarts: how many dead or hanging workers are replaced before the collection gives up.
        ray_address: address of the Ray cluster; empty means `$RAY_ADDRESS`, or a cluster of this machine alone.
    """

    backend: Literal["local", "ray"] = "local"
    timeout_s: float = 120.0
    restarts: int = 5
    ray_address: str = ""

    def __post_init__(self) -> None:
        _check(self.timeout_s > 0.0, "collector.timeout_s", self.timeout_s, "a number of seconds above 0")
        _check(self.restarts >= 0, "collector.restarts", self.restarts, "0 or more")


@dataclass(frozen=True)
class SAViConfig:
    """Sizes of SAVi (system.md section 1; paper, appendix A.1).

    Attributes:
        n_slots: N.
        slot_dim: D.
        initial: `gaussian` (learned mean and scale shared by all slots; paper) or `learned` (one vector per slot).
        encoder: `full` (four 5x5 stride-1 convs; paper) or `strided` (5x5 convs with `encoder_strides`).
        encoder_channels: channels of each encoder conv.
        encoder_strides: strides of the encoder convs (all 1 for `full`).
        token_dim: width of the encoder tokens' MLP and of q, k, v.
        decoder: `broadcast` (full-resolution spatial broadcast; paper) or `pixel_shuffle` (from 8x8 upwards).
        decoder_channels: channels of the decoder.
        collapse: use the collapsed first layer of the broadcast decoder (exact; `false` computes it plainly).
        first_iterations: Slot Attention iterations on an episode's first frame.
        iterations: iterations on every later frame.
        corrector_mlp: hidden width of the corrector's residual MLP.
        transition_heads: heads of the transition block, of width D / heads.
        transition_mlp: hidden width of the transition block's MLP.
    """

    n_slots: int = 4
    slot_dim: int = 128
    initial: Literal["gaussian", "learned"] = "gaussian"
    encoder: Literal["full", "strided"] = "full"
    encoder_channels: tuple[int, ...] = (32, 32, 32, 32)
    encoder_strides: tuple[int, ...] = (1, 1, 1, 1)
    token_dim: int = 128
    decoder: Literal["broadcast", "pixel_shuffle"] = "broadcast"
    decoder_channels: tuple[int, ...] = (64, 64, 64, 64)
    collapse: bool = True
    first_iterations: int = 3
    iterations: int = 1
    corrector_mlp: int = 256
    transition_heads: int = 4
    transition_mlp: int = 512

    def __post_init__(self) -> None:
        _check(self.n_slots >= 1, "model.savi.n_slots", self.n_slots, "at least 1")
        _check(
            len(self.encoder_channels) == len(self.encoder_strides),
            "model.savi.encoder_strides",
            self.encoder_strides,
            f"one stride for each of the {len(self.encoder_channels)} encoder channels",
        )
        _check(
            self.slot_dim % self.transition_heads == 0,
            "model.savi.transition_heads",
            self.transition_heads,
            f"a divisor of slot_dim {self.slot_dim}",
        )


@dataclass(frozen=True)
class InverseDynamicsConfig:
    """Sizes of InvDyn and its quantiser (system.md section 2; paper, appendix A.2).

    Attributes:
        variant: `single` (InvDyn_S, one z per step) or `multi` (InvDyn_M, one z per slot and step).
        mode: latent-action mode.
        latent_dim: Z.
        n_prototypes: K.
        dim, layers, heads, head_dim, mlp_dim: transformer of InvDyn_S; `dim` is the hidden width of InvDyn_M.
        decay: EMA decay of the codebook.
        dead_threshold: EMA cluster size under which a code is revived by a random latent of the batch.
        commitment: weight beta of the commitment term.
        sample: sample z at evaluation too (training always samples).
    """

    variant: Literal["single", "multi"] = "single"
    mode: LatentMode = "hybrid"
    latent_dim: int = 16
    n_prototypes: int = 8
    dim: int = 256
    layers: int = 4
    heads: int = 4
    head_dim: int = 64
    mlp_dim: int = 1024
    decay: float = 0.99
    dead_threshold: float = 1.0
    commitment: float = 0.25
    sample: bool = False

    def __post_init__(self) -> None:
        _check(0.0 < self.decay < 1.0, "model.inverse_dynamics.decay", self.decay, "a number in (0, 1)")
        _check(self.n_prototypes >= 2, "model.inverse_dynamics.n_prototypes", self.n_prototypes, "at least 2")


@dataclass(frozen=True)
class PredictorConfig:
    """Sizes of cOCVP (system.md section 3; paper, appendix A.3).

    Attributes:
        dim, layers, heads, head_dim, mlp_dim: the transformer.
        residual: predict the change of the slots instead of the slots.
        context: frames it attends to; past them the window slides and is recomputed.
    """

    dim: int = 256
    layers: int = 4
    heads: int = 8
    head_dim: int = 64
    mlp_dim: int = 1024
    residual: bool = False
    context: int = 24

    def __post_init__(self) -> None:
        _check(self.context >= 2, "model.predictor.context", self.context, "at least 2 frames")


@dataclass(frozen=True)
class PolicyConfig:
    """Sizes of the latent policy: InvDyn_S's architecture with one head (paper, appendix A.4)."""

    dim: int = 256
    layers: int = 4
    heads: int = 4
    head_dim: int = 64
    mlp_dim: int = 1024


@dataclass(frozen=True)
class ActionDecoderConfig:
    """Sizes of the action decoder: a three-layer MLP (paper, appendix A.4)."""

    hidden_dim: int = 128


@dataclass(frozen=True)
class ModelConfig:
    """All sizes."""

    savi: SAViConfig = field(default_factory=SAViConfig)
    inverse_dynamics: InverseDynamicsConfig = field(default_factory=InverseDynamicsConfig)
    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    action_decoder: ActionDecoderConfig = field(default_factory=ActionDecoderConfig)


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its schedule.

    Attributes:
        lr: base learning rate.
        warmup_steps: linear warm-up.
        schedule: `cosine` to zero over the stage's steps after warm-up, or `constant`.
        grad_clip: maximum gradient norm; 0 switches clipping off.
    """

    lr: float = 1e-4
    warmup_steps: int = 0
    schedule: Literal["cosine", "constant"] = "cosine"
    grad_clip: float = 0.05


@dataclass(frozen=True)
class StageConfig:
    """What every training stage has.

    Attributes:
        steps: optimiser steps.
        batch_size: windows per step.
        optim: optimiser.
        precision: `bf16` autocasts the convolutions.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.
        log_every: steps between log lines.
    """

    steps: int = 200_000
    batch_size: int = 64
    optim: OptimConfig = field(default_factory=OptimConfig)
    precision: Precision = "fp32"
    checkpoint_every: int = 1000
    validate_every: int = 1000
    log_every: int = 50

    def __post_init__(self) -> None:
        _check(self.steps >= 1, "steps", self.steps, "at least 1")
        _check(self.batch_size >= 1, "batch_size", self.batch_size, "at least 1")
        _check(self.checkpoint_every >= 1, "checkpoint_every", self.checkpoint_every, "at least 1")


@dataclass(frozen=True)
class SlotsStageConfig(StageConfig):
    """Stage 1, SAVi.

    Attributes:
        clip_frames: frames per clip.
    """

    clip_frames: int = 8


@dataclass(frozen=True)
class DynamicsStageConfig(StageConfig):
    """Stage 2, InvDyn and cOCVP.

    Attributes:
        seed_frames: parsed frames a rollout starts from.
        predicted_frames: frames predicted after the seed.
        from_start: fraction of the clips that start at their episode's first frame, as imagination does.
        teacher_steps: first steps in which every input is a parsed slot (one parallel pass; 0 in the paper).
        decoded_frames: predicted frames decoded for the image loss, drawn at random; 0 decodes all of them.
        image_weight, slot_weight, vq_weight: loss weights (lambda of Eq. "full loss").
    """

    seed_frames: int = 6
    predicted_frames: int = 8
    from_start: float = 0.0
    teacher_steps: int = 0
    decoded_frames: int = 0
    image_weight: float = 1.0
    slot_weight: float = 1.0
    vq_weight: float = 0.25

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self.seed_frames >= 1, "dynamics.seed_frames", self.seed_frames, "at least 1")
        _check(self.predicted_frames >= 1, "dynamics.predicted_frames", self.predicted_frames, "at least 1")


@dataclass(frozen=True)
class BehaviourStageConfig(StageConfig):
    """Stage 3, latent policy, action decoder and the slot oracle.

    Attributes:
        labelled_demos: demonstrations whose real actions the action decoder may see.
        imagined: also clone from slots that cOCVP predicts along each demonstration.
        loss: `l2` (paper) or `l1`, of policy, oracle and decoder. Where an expert switches at once between opposite
            actions, the mean that `l2` finds is neither, and the policy dithers; the median is one of them.
        slot_noise: standard deviation of Gaussian noise added to the slots that policy and oracle clone from (0 in the
            paper); slots have a standard deviation of about 0.7, and a prediction is about 0.03 off.
        decoder_inputs: `inverse_dynamics` (InvDyn's latents; paper), `policy` (the policy's outputs) or `both`.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest of `optim` is shared.
        oracle: also train the slot oracle (same network on the real actions of all demos).
    """

    labelled_demos: int = 50
    imagined: bool = True
    loss: Literal["l2", "l1"] = "l2"
    slot_noise: float = 0.0
    decoder_inputs: Literal["inverse_dynamics", "policy", "both"] = "inverse_dynamics"
    decoder_steps: int = 2000
    decoder_lr: float = 2e-4
    oracle: bool = True


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation.

    Attributes:
        references: also run the random, expert and slot-oracle references.
        seed_offset: added to `seed`, far above every collection seed, so that no episode was seen in training.
    """

    references: bool = True
    seed_offset: int = 1_000_000_000


@dataclass(frozen=True)
class LoggingConfig:
    """Logging: `tensorboard` (default), `wandb`, `trackio` or `none`, and a progress bar."""

    backend: Literal["tensorboard", "wandb", "trackio", "none"] = "tensorboard"
    progress: bool = True
    project: str = "playslot_rl"


@dataclass(frozen=True)
class ExperimentConfig:
    """Everything a command needs.

    Attributes:
        preset: name of the preset the values came from.
        policy: collector policy of `collect`: `random` or `expert`.
        episodes: episodes to collect or to evaluate; None means the command's default.
        seed: seed of data collection, training or evaluation.
        workers: collector processes; 0 means one per core.
        out: folder to write.
        run: run folder to read (and to write where `out` is empty); `pretrained` names the shipped model.
        protocol: evaluation protocol.
        device: torch device; empty means a GPU if there is one.
        threads: torch threads; 0 leaves torch's choice.
    """

    preset: str = "paper"
    policy: Literal["random", "expert"] = "expert"
    episodes: int | None = None
    seed: int = 0
    workers: int = 0
    out: str = ""
    run: str = ""
    protocol: Literal["simulation", "imagination"] = "simulation"
    device: str = ""
    threads: int = 0
    env: EnvConfig = field(default_factory=EnvConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    data: DataConfig = field(default_factory=DataConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    slots: SlotsStageConfig = field(default_factory=SlotsStageConfig)
    dynamics: DynamicsStageConfig = field(default_factory=DynamicsStageConfig)
    behaviour: BehaviourStageConfig = field(default_factory=BehaviourStageConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig)

    def __post_init__(self) -> None:
        _check(self.episodes is None or self.episodes >= 1, "episodes", self.episodes, "at least 1")
        _check(self.seed >= 0, "seed", self.seed, "a non-negative integer")
        _check(self.workers >= 0, "workers", self.workers, "0 (one per core) or more")
