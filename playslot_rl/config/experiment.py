"""Config of a command: data, collection, evaluation, logging, and everything together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.baselines import BaselinesConfig
from playslot_rl.config.baselines import baselines as default_baselines
from playslot_rl.config.compare import CompareConfig
from playslot_rl.config.compare_video import CompareVideoConfig
from playslot_rl.config.env import EnvConfig, RenderConfig
from playslot_rl.config.methods import require_method
from playslot_rl.config.model import ModelConfig
from playslot_rl.config.plain import check
from playslot_rl.config.planning import PlanConfig
from playslot_rl.config.roles import (
    COUNT,
    EPISODE_COUNT,
    NOT_NEGATIVE,
    SEED,
    UNSAID,
    YEAR_MINUTES,
    Checked,
    above_zero,
    at_least,
    below_one,
    between,
    role,
    text,
    was,
)
from playslot_rl.config.sizes import is_amount
from playslot_rl.config.stages import BehaviourStageConfig, DynamicsStageConfig, SlotsStageConfig
from playslot_rl.seeds.episodes import EPISODES, EVALUATION

WORKERS = at_least(0, "0 (one per core) or more", 1024)


@dataclass(frozen=True)
class DataConfig(Checked):
    """Where data come from.

    Attributes:
        root: LeRobot v3.0 data set(s) of unlabelled videos, separated by commas. With `stream` also
            `hf://datasets/USER/NAME[@REVISION]`, read where it lies (`playslot_rl.data.remote`).
        demos: data set of demonstrations; empty means `root`.
        held_out: how many last episodes, of each task in proportion, are neither trained on nor shown to the world
            model: they measure.
        draw: seed that draws which of the other demonstrations are the first ones; None takes them as recorded.
        camera: image feature(s) to read, separated by commas; empty means the only one.
        stride: of each episode every `stride`-th frame is read (`playslot_rl.data.views.every`); policies act at that
            rate.
        stride_action: of the actions up to the next frame read, their `mean`, or the `last`: for absolute targets,
            grippers and angles that wrap.
        resize: resize frames of another size than `env.image_size` (area averaging) instead of refusing them.
        cache: folder of the frame and slot caches; empty means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`.
        cache_limit: of all caches there together, such as `20GB`; the least recently used make room, never what a
            process uses. Empty has none.
        workers: processes that decode a data set into the frame cache; 0 means one per core.
        stream: decode frames while they are read instead of into the cache, for sets larger than the disk.
        shuffle_buffer: frames in memory from which windows are drawn with `stream`.
        device: `auto` keeps frames and slots of a set in a GPU's memory where they fit; `cpu` copies those of each
            batch there.
        drawn: every training batch is drawn anew (`env=grid_shapes`); the data set only validates.
        validation: fraction of episodes held out from training.
        tested: fraction of episodes that no training and no validation sees, for `compare-video`; 0 keeps none.
    """

    group = "data."
    root: str = field(default="", metadata=role("machine", "folder"))
    demos: str = field(default="", metadata=role("machine", "folder"))
    held_out: int = field(default=0, metadata=role("machine") | at_least(0, "0 or more"))
    draw: int | None = field(default=None, metadata=SEED)
    camera: str = ""
    stride: int = field(default=1, metadata=at_least(1, "1 (every frame) or more"))
    stride_action: Literal["mean", "last"] = field(default="mean", metadata=was("mean") | UNSAID)
    resize: bool = False
    cache: str = field(default="", metadata=role("machine", "folder"))
    cache_limit: str = field(default="", metadata=role("machine") | text(is_amount, "an amount such as 20GB"))
    workers: int = field(default=1, metadata=role("machine") | WORKERS)
    stream: bool = False
    shuffle_buffer: int = field(default=20_000, metadata=at_least(1))
    device: Literal["auto", "cpu"] = field(default="auto", metadata=role("machine"))
    drawn: bool = field(default=False, metadata=was(False))
    validation: float = field(default=0.05, metadata=below_one())
    tested: float = field(default=0.0, metadata=below_one())


@dataclass(frozen=True)
class CollectConfig(Checked):
    """What the collectors record (agent steps; an episode has one more frame than actions).

    Attributes:
        random_episodes: episodes of the random policy that `pipeline` collects.
        random_steps: agent steps of each.
        expert_episodes: demonstrations that `pipeline` collects for the policy.
        validation_episodes: further ones that only measure: `demo`, `pipeline` and `compare` record so many more. Of
            any data set, at most so many of its last episodes, beyond those trained on, are looked at in validation.
        expert_steps: agent steps of each; clips go on past success.
        noise: standard deviation of Gaussian noise added to the expert's actions.
        noisy_episodes: episodes of the noisy expert that `pipeline` adds to the world model's videos.
        exploration_noise: standard deviation of its noise.
        learn_from_demos: whether the world model learns from the demonstrations' videos too (never their actions).
        storage: `image` (PNG in parquet, lossless) or `video` (h264 yuv444p, crf 0).
    """

    group = "collect."
    random_episodes: int = field(default=400, metadata=EPISODE_COUNT)
    random_steps: int = field(default=20, metadata=COUNT)
    expert_episodes: int = field(default=150, metadata=EPISODE_COUNT)
    validation_episodes: int = field(default=10, metadata=role("machine") | EPISODE_COUNT)
    expert_steps: int = field(default=20, metadata=COUNT)
    noise: float = field(default=0.0, metadata=NOT_NEGATIVE)
    noisy_episodes: int = field(default=0, metadata=EPISODE_COUNT)
    exploration_noise: float = field(default=0.5, metadata=NOT_NEGATIVE)
    learn_from_demos: bool = False
    storage: Literal["image", "video"] = "image"


@dataclass(frozen=True)
class CollectorConfig(Checked):
    """How episodes are recorded, never what: the data do not depend on it.

    Attributes:
        backend: `local` processes of this machine, or actors of a `ray` cluster.
        timeout_s: seconds without an episode after which a worker counts as hanging and is started again.
        restarts: how many dead or hanging workers are replaced before the collection gives up.
        ray_address: address of the Ray cluster; empty means `$RAY_ADDRESS`, or a cluster of this machine alone.
    """

    group = "collector."
    backend: Literal["local", "ray"] = "local"
    timeout_s: float = field(default=120.0, metadata=above_zero("a number of seconds above 0"))
    restarts: int = field(default=5, metadata=at_least(0, "0 or more"))
    ray_address: str = ""


@dataclass(frozen=True)
class EvaluationConfig(Checked):
    """Evaluation.

    Attributes:
        references: also run the random, expert and slot-oracle references.
        seed_offset: first number of the episodes of small seeds (`playslot_rl.seeds.episodes`), above all collections'.
            Below that only the records of the training data sets keep episodes apart.
    """

    group = "evaluation."
    references: bool = True
    seed_offset: int = field(default=EVALUATION, metadata=between(0, 2 * EVALUATION, f"0 to {2 * EVALUATION}"))


@dataclass(frozen=True)
class ExportConfig:
    """Where `export` pushes the model folder; nowhere with an empty `repo`.

    Attributes:
        repo: `user/name` on the Hugging Face Hub; made if it is not there.
        private: make it private; refused where it is public.
        branch: empty means main.
        tag: one more name for the commit; never moved.
    """

    repo: str = ""
    private: bool = False
    branch: str = ""
    tag: str = ""


@dataclass(frozen=True)
class PlayConfig(Checked):
    """The page of `play`.

    Attributes:
        show: open it in the browser; its address is printed in any case.
        fps: imagined frames a second of free play, at first; the page has a slider for it.
    """

    group = "play."
    show: bool = False
    fps: float = field(default=8.0, metadata=between(1, 15, "1 to 15"))


@dataclass(frozen=True)
class AdoptConfig(Checked):
    """What is tried and how the time is spent.

    Attributes:
        slots: numbers of slots that are tried; one of them is taken as it is.
        prototypes: size of the codebook in the trial that decides how many prototypes there are.
        tolerance: a smaller number of slots is taken where its error is at most this fraction above the least.
        patience: validations without a lower error after which a training ends.
    """

    group = "adopt."
    slots: tuple[int, ...] = field(default=(4, 6, 8), metadata=at_least(2, "numbers of slots from 2 on", 256))
    prototypes: int = field(default=16, metadata=at_least(4, largest=4096))
    tolerance: float = field(default=0.05, metadata=below_one())
    patience: int = field(default=3, metadata=at_least(1))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.slots:
            raise ValueError("adopt.slots: got none, expected at least one number of slots, such as [4,6,8]")


@dataclass(frozen=True)
class MetricsConfig:
    """Metrics that need something from elsewhere.

    Attributes:
        lpips_weights: file of torchvision's AlexNet for LPIPS; empty takes torch's cache where it has them.
    """

    lpips_weights: str = field(default="", metadata=role("folder"))


@dataclass(frozen=True)
class LoggingConfig:
    """Where a training says how it goes.

    Attributes:
        backend: `tensorboard` (default), `wandb`, `trackio` or `none`.
        progress: show a progress bar.
        project: the project's name for `wandb` and `trackio`.
    """

    backend: Literal["tensorboard", "wandb", "trackio", "none"] = "tensorboard"
    progress: bool = True
    project: str = "playslot_rl"


@dataclass(frozen=True)
class ExperimentConfig(Checked):
    """Everything a command needs.

    Attributes:
        preset: name of the preset the values came from.
        policy: collector policy of `collect`: `random`, `expert`, or `noisy_expert`: with `collect.exploration_noise`,
            and random goals of `env=ogbench`.
        episodes: episodes to collect or to evaluate; None means the command's default.
        seed: seed of data collection, training or evaluation, any 32-bit number.
        workers: collector processes; 0 means one per core.
        out: folder to write.
        run: run folder to read (and to write where `out` is empty); `pretrained` names the task's own model.
        protocol: evaluation protocol: a policy in `simulation` or `imagination`, its decoder in a `replay` of the
            expert's videos, the `slots` it builds on, or its `actions` beside those of held-out demonstrations.
        device: torch device; empty means a GPU if there is one.
        threads: torch threads; 0 leaves torch's choice.
        method: what `train-baseline` trains (a name of `playslot_rl.config.methods`).
        minutes: of wall-clock time that `adopt` may take.
        demos: demonstrations of the data set to use, the first ones; None means all.
        port: of the page of `play`; 0 (or nothing) takes 8080, or the next one that is free.
    """

    preset: str = field(default="paper", metadata=role("machine"))
    policy: Literal["random", "expert", "noisy_expert"] = field(default="expert", metadata=role("call"))
    episodes: int | None = field(default=None, metadata=role("call") | at_least(1, largest=EPISODES))
    seed: int = field(default=0, metadata=SEED)
    workers: int = field(default=0, metadata=role("call", "machine") | WORKERS)
    out: str = field(default="", metadata=role("call", "machine", "folder"))
    run: str = field(default="", metadata=role("call", "machine", "folder"))
    protocol: Literal["simulation", "imagination", "replay", "slots", "actions"] = field(
        default="simulation", metadata=role("call")
    )
    device: str = field(default="", metadata=role("call", "machine"))
    threads: int = field(default=0, metadata=role("machine") | at_least(0, "0 (torch's choice) or more", 1024))
    minutes: float = field(default=60.0, metadata=role("call", "machine", "free") | above_zero(largest=YEAR_MINUTES))
    method: str = "playslot"
    demos: int | None = field(default=None, metadata=at_least(1))
    port: int = field(default=0, metadata=role("call", "machine") | between(0, 65535, "0 (any) to 65535"))
    env: EnvConfig = field(default_factory=EnvConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    data: DataConfig = field(default_factory=DataConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig, metadata=role("call", "machine"))
    model: ModelConfig = field(default_factory=ModelConfig)
    slots: SlotsStageConfig = field(default_factory=SlotsStageConfig)
    dynamics: DynamicsStageConfig = field(default_factory=DynamicsStageConfig)
    behaviour: BehaviourStageConfig = field(default_factory=BehaviourStageConfig)
    baselines: BaselinesConfig = field(default_factory=default_baselines)
    compare: CompareConfig = field(default_factory=CompareConfig, metadata=role("machine"))
    compare_video: CompareVideoConfig = field(default_factory=CompareVideoConfig, metadata=role("machine"))
    plan: PlanConfig = field(default_factory=PlanConfig, metadata=role("call", "machine"))
    metrics: MetricsConfig = field(default_factory=MetricsConfig, metadata=role("machine"))
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig, metadata=role("machine"))
    adopt: AdoptConfig = field(default_factory=AdoptConfig, metadata=role("call", "machine"))
    export: ExportConfig = field(default_factory=ExportConfig, metadata=role("call"))
    play: PlayConfig = field(default_factory=PlayConfig, metadata=role("call", "machine"))

    @property
    def acting(self) -> EnvConfig:
        """The task as policies act in it, `data.stride` frames of the data a step."""
        return self.env.every(self.data.stride)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_method("method", self.method)
        drawable = self.env.name == "grid_shapes" or not self.data.drawn
        check(drawable, "data.drawn", True, f"false with env={self.env.name}, whose clips cannot be drawn")
