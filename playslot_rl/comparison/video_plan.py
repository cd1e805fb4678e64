"""Which trainings a video comparison has: one for each method and training seed, the same clips and budget for all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from playslot_rl.comparison.plan import absolute
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compare_video import ON_SLOTS, TITLES, CompareVideoConfig, VideoMethod
from playslot_rl.config.methods import MethodName
from playslot_rl.config.roles import without


@dataclass(frozen=True)
class VideoJob:
    """One training and its scores.

    Attributes:
        method: what is trained.
        seed: of the training.
        out: folder of the comparison.
    """

    method: VideoMethod
    seed: int
    out: Path

    @property
    def name(self) -> str:
        """Such as `svg-s0`."""
        return f"{self.method}-s{self.seed}"

    @property
    def title(self) -> str:
        """As tables and plots name it."""
        return TITLES[self.method]

    @property
    def trained_as(self) -> MethodName:
        """Its name among `playslot_rl.config.methods`."""
        return "playslot" if self.method == "playslot_m" else self.method

    @property
    def stage(self) -> str:
        """Stage of the run whose checkpoint is the method's."""
        return "dynamics" if self.trained_as == "playslot" else self.method

    @property
    def file(self) -> Path:
        """What it is told."""
        return self.out / "jobs" / f"{self.name}.json"

    @property
    def run(self) -> Path:
        """The run folder it writes."""
        return self.out / "runs" / self.name

    @property
    def wave(self) -> int:
        """All at once."""
        return 0

    @property
    def trials(self) -> Path:
        """Folder of the trials of learning rates."""
        return self.out / "trials" / self.name

    @property
    def choice(self) -> Path:
        """The learning rate and the number of steps that they led to."""
        return self.trials / "choice.json"

    @property
    def scores(self) -> Path:
        """What it scored."""
        return self.run / "video.json"

    @property
    def pictures(self) -> Path:
        """Its predictions of the first clips."""
        return self.run / "video.npz"


def video_jobs(config: ExperimentConfig, out: Path) -> list[VideoJob]:
    """All trainings, in the order in which they run: the methods side by side, seed by seed."""
    wanted = config.compare_video
    return [VideoJob(method, seed, out) for seed in wanted.seeds for method in wanted.methods]


def uses_slots(config: ExperimentConfig) -> bool:
    """Whether a method builds on SAVi's slots."""
    return any(method in ON_SLOTS for method in config.compare_video.methods)


def with_training(config: ExperimentConfig, method: VideoMethod, **changes: Any) -> ExperimentConfig:
    """The config with some settings of a method's training changed."""
    if method.startswith("playslot"):
        return replace(config, dynamics=replace(config.dynamics, **changes))
    own = replace(getattr(config.baselines, method), **changes)
    return replace(config, baselines=replace(config.baselines, **{method: own}))


def training_of(config: ExperimentConfig, method: VideoMethod) -> Any:
    """A method's training settings, a `StageConfig`."""
    return config.dynamics if method.startswith("playslot") else getattr(config.baselines, method)


def video_job_config(config: ExperimentConfig, job: VideoJob, world: str) -> ExperimentConfig:
    """What a job trains with: the preset's settings, on clips of the same lengths for every method.

    Args:
        config: of the comparison, with `data` complete.
        job: which one.
        world: run folder of the SAVi, or `pretrained`.
    """
    own = config.compare_video
    if job.method == "playslot_m":
        inverse = replace(config.model.inverse_dynamics, variant="multi")
        config = replace(config, model=replace(config.model, inverse_dynamics=inverse))
    config = with_training(config, job.method, seed_frames=own.trained_seed, predicted_frames=own.trained_frames)
    data = replace(
        config.data,
        root=",".join(absolute(part.strip()) for part in config.data.root.split(",")),
        demos="",
        held_out=0,
        tested=0.0 if own.test else own.tested,
        cache=absolute(config.data.cache),
    )
    return replace(
        config,
        compare_video=replace(own, test=absolute(own.test)),
        method=job.trained_as,
        seed=job.seed,
        data=data,
        out=absolute(str(job.run)),
        run=absolute(world) if job.method in ON_SLOTS else "",
        logging=replace(config.logging, progress=False),
    )


def video_job_record(job: VideoJob, config: ExperimentConfig, parents: Mapping[str, str]) -> dict[str, Any]:
    """What the job's file says.

    Args:
        job: which one.
        config: its own (`video_job_config`).
        parents: fingerprints of the slots and the videos it builds on.
    """
    own = to_dict(config.compare_video)
    asked = {key: own[key] for key in own if key not in ("methods", "seeds", "launcher", "hydra")}
    result = without(config, "machine")
    result.pop("compare_video", None)
    result["baselines"] = result["baselines"].get(job.method, {})  # another method's settings are none of this job's
    content = {key: value for key, value in asked.items() if key != "test"}  # of a data set the content counts
    identity = json.dumps([result, content, dict(parents)], sort_keys=True)
    return {
        "kind": "video",
        "name": job.name,
        "method": job.method,
        "seed": job.seed,
        "out": absolute(str(job.out)),
        "asked": asked,
        "fingerprint": hashlib.sha256(identity.encode()).hexdigest()[:16],
        "config": to_dict(config),
    }


def asked_of(record: Mapping[str, Any]) -> CompareVideoConfig:
    """The comparison's settings that a job's file names."""
    from playslot_rl.config.plain import from_dict

    return from_dict(CompareVideoConfig, dict(record["asked"]))
