"""The configuration: frozen dataclasses are the truth, YAML and command-line overrides only change their values.

`from_dict` builds a config from nested plain dicts (what Hydra composes) and refuses unknown keys;
`to_dict` is its inverse; `fingerprint` names a config by its content (all three: `playslot_rl.config.plain`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from playslot_rl.config.baselines import BaselinesConfig as BaselinesConfig
from playslot_rl.config.compare import CompareConfig as CompareConfig
from playslot_rl.config.data import CollectConfig as CollectConfig
from playslot_rl.config.data import CollectorConfig as CollectorConfig
from playslot_rl.config.data import DataConfig as DataConfig
from playslot_rl.config.env import BlocksConfig as BlocksConfig
from playslot_rl.config.env import EnvConfig as EnvConfig
from playslot_rl.config.env import GridConfig as GridConfig
from playslot_rl.config.env import RenderConfig as RenderConfig
from playslot_rl.config.methods import MethodName as MethodName
from playslot_rl.config.model import ActionDecoderConfig as ActionDecoderConfig
from playslot_rl.config.model import InverseDynamicsConfig as InverseDynamicsConfig
from playslot_rl.config.model import LatentMode as LatentMode
from playslot_rl.config.model import ModelConfig as ModelConfig
from playslot_rl.config.model import PolicyConfig as PolicyConfig
from playslot_rl.config.model import PredictorConfig as PredictorConfig
from playslot_rl.config.model import SAViConfig as SAViConfig
from playslot_rl.config.plain import check
from playslot_rl.config.plain import fingerprint as fingerprint
from playslot_rl.config.plain import from_dict as from_dict
from playslot_rl.config.plain import to_dict as to_dict
from playslot_rl.config.stage import OptimConfig as OptimConfig
from playslot_rl.config.stage import Precision as Precision
from playslot_rl.config.stage import StageConfig as StageConfig


@dataclass(frozen=True)
class SlotsStageConfig(StageConfig):
    """Stage 1, SAVi.

    Attributes:
        clip_frames: frames per clip.
        start_from: run (or `pretrained/ENV`) whose SAVi this one starts from; empty starts from scratch (paper).
    """

    clip_frames: int = 8
    start_from: str = ""


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
        check(self.seed_frames >= 1, "dynamics.seed_frames", self.seed_frames, "at least 1")
        check(self.predicted_frames >= 1, "dynamics.predicted_frames", self.predicted_frames, "at least 1")


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
        shift: policy, oracle and decoder also learn from copies of the demonstrations moved by so many pixels, with the
            same actions (0 in the paper, none): from ten demonstrations a policy learns where it has been.
        shifted_copies: how many, of the eight directions (`playslot_rl.data.shifted.DIRECTIONS`).
        decoder_inputs: `inverse_dynamics` (InvDyn's latents; paper), `policy` (the policy's outputs) or `both`.
        decoder_steps: optimiser steps of the action decoder.
        decoder_lr: its base learning rate; the rest of `optim` is shared.
        oracle: also train the slot oracle (same network on the real actions of all demos).
    """

    labelled_demos: int = 50
    imagined: bool = True
    loss: Literal["l2", "l1"] = "l2"
    slot_noise: float = 0.0
    shift: int = 0
    shifted_copies: int = 8
    decoder_inputs: Literal["inverse_dynamics", "policy", "both"] = "inverse_dynamics"
    decoder_steps: int = 2000
    decoder_lr: float = 2e-4
    oracle: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0 <= self.shift <= 16, "behaviour.shift", self.shift, "0 to 16 pixels")
        check(1 <= self.shifted_copies <= 8, "behaviour.shifted_copies", self.shifted_copies, "1 to 8")


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
        method: what `train-baseline` trains (a name of `playslot_rl.config.methods`).
        demos: demonstrations of the data set to use, the first ones; None means all.
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
    method: MethodName = "playslot"
    demos: int | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    data: DataConfig = field(default_factory=DataConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    slots: SlotsStageConfig = field(default_factory=SlotsStageConfig)
    dynamics: DynamicsStageConfig = field(default_factory=DynamicsStageConfig)
    behaviour: BehaviourStageConfig = field(default_factory=BehaviourStageConfig)
    baselines: BaselinesConfig = field(default_factory=BaselinesConfig)
    compare: CompareConfig = field(default_factory=CompareConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    logging: LoggingConfig = field(default_factory=LoggingConfig)
    export: ExportConfig = field(default_factory=ExportConfig)

    def __post_init__(self) -> None:
        check(self.episodes is None or self.episodes >= 1, "episodes", self.episodes, "at least 1")
        check(self.seed >= 0, "seed", self.seed, "a non-negative integer")
        check(self.demos is None or self.demos >= 1, "demos", self.demos, "at least 1")
        check(self.workers >= 0, "workers", self.workers, "0 (one per core) or more")
