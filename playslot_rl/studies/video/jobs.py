"""Jobs of a comparison of videos: one for each method and training seed, the same clips and budget for all."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from playslot_rl.config import ExperimentConfig, from_dict, to_dict
from playslot_rl.config.compare_video import CompareVideoConfig, method_of, title_of
from playslot_rl.config.plain import flatten, put
from playslot_rl.errors import ConfigError
from playslot_rl.studies.study import Job, absolute, computed, fingerprint_of, job_config

VARIED = ("model.inverse_dynamics.", "model.predictor.", "dynamics.")
"""Where the settings are that change what PlaySlot predicts, on a SAVi that is there."""
PHASES = ("teacher_steps", "warmup_steps", "anneal_steps", "growth_steps", "validate_every")
"""Settings of a training that are parts of its steps."""
_INVERSE: Final[Mapping[str, Literal["single", "multi"]]] = {"playslot": "single", "playslot_m": "multi"}
"""Variant of InvDyn of each row of PlaySlot."""
TRIAL_SEED = 0
"""Of the trials of learning rates, whatever the seeds of the trainings that take the rate from them."""
NOT_OF_A_JOB = ("methods", "seeds", "vary", "values", "objects", "processes", "launcher", "hydra")
"""Settings of the whole comparison: another choice of them leaves a job as it is."""


@dataclass(frozen=True)
class VideoJob(Job):
    """One training and its scores.

    Attributes:
        variant: setting and value it is trained with, as `mode=hybrid`; empty trains it as the config says.
    """

    method: str
    seed: int
    out: Path
    variant: str = ""

    @property
    def name(self) -> str:
        """Such as `svg-s0` or `playslot-mode-hybrid-s0`."""
        return f"{self._method_name}-s{self.seed}"

    @property
    def value(self) -> str:
        return self.variant.partition("=")[2]

    @property
    def title(self) -> str:
        return f"{title_of(self.method)}, {self.variant}" if self.variant else title_of(self.method)

    @property
    def trained_as(self) -> str:
        """Its name among `playslot_rl.config.methods`."""
        return method_of(self.method).name

    @property
    def stage(self) -> str:
        return "dynamics" if method_of(self.method).imagines else self.method

    @property
    def _method_name(self) -> str:
        variant = re.sub(r"[^\w.]+", "-", self.variant).strip("-")
        return "-".join(part for part in (self.method, variant) if part)

    @property
    def trials(self) -> Path:
        return self.out / "trials" / self._method_name

    def trial(self, rate: float) -> Path:
        """Run folder of the trial of a factor of the learning rate."""
        return self.trials / f"rate_{rate:g}"

    @property
    def choice(self) -> Path:
        """The learning rate and the number of steps that they led to."""
        return self.trials / "choice.json"

    @property
    def scores(self) -> Path:
        return self.run / "video.json"

    @property
    def pictures(self) -> Path:
        return self.run / "video.npz"


def video_jobs(config: ExperimentConfig, out: Path) -> list[VideoJob]:
    """All trainings, in the order in which they run: the methods side by side, seed by seed."""
    wanted = config.compare_video
    name = wanted.vary.rpartition(".")[2]
    variants = [f"{name}={value}" for value in wanted.values] or [""]
    return [
        VideoJob(method, seed, out, variant)
        for seed in wanted.seeds
        for method in wanted.methods
        for variant in (variants if method_of(method).imagines else [""])
    ]


def check_variants(config: ExperimentConfig) -> None:
    """Refuse a setting that is not there or that a comparison sets itself, and values it cannot have: a ConfigError."""
    own = config.compare_video
    if own.vary and not any(method_of(method).imagines for method in own.methods):
        raise ConfigError(f"vary: got methods={','.join(own.methods)}, expected playslot or playslot_m among them")
    if own.vary == "dynamics.steps" and own.budget_minutes:
        raise ConfigError("vary: got dynamics.steps with compare_video.budget_minutes, expected one of them")
    for job in video_jobs(config, Path()):
        if job.variant:
            wanted = _with_setting(config, own.vary, job.value)
            made, meant = (flatten(to_dict(one))[own.vary] for one in (video_config(config, job, ""), wanted))
            if made != meant:
                raise ConfigError(
                    f"values: got {job.value} for {own.vary}, expected what a comparison leaves as it is: methods, "
                    "lengths of clips and the context they allow are its own (compare_video.*)"
                )


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text  # a name, such as `hybrid`


def _with_setting(config: ExperimentConfig, key: str, text: str) -> ExperimentConfig:
    """The config with one setting of inverse dynamics, predictor or their training changed."""
    values = to_dict(config)
    if not key.startswith(VARIED) or key not in flatten(values):
        known = ", ".join(part.removesuffix(".") for part in VARIED)
        raise ConfigError(f"vary: got {key!r}, expected a setting under {known}")
    put(values, key, _parsed(text))
    try:
        return from_dict(ExperimentConfig, values)
    except ValueError as error:
        raise ConfigError(f"values: got {text!r} for {key}: {error}") from None


def makes_trials(asked: CompareVideoConfig) -> bool:
    """Whether trainings are tried in small first: for a choice of learning rates, or to know what a step takes."""
    return len(asked.rates) > 1 or bool(asked.budget_minutes)


def uses_slots(config: ExperimentConfig) -> bool:
    return any(method_of(method).slots for method in config.compare_video.methods)


def with_training(config: ExperimentConfig, method: str, **changes: Any) -> ExperimentConfig:
    if method_of(method).imagines:
        return replace(config, dynamics=replace(config.dynamics, **changes))
    own = replace(getattr(config.baselines, method), **changes)
    return replace(config, baselines=replace(config.baselines, **{method: own}))


def training_of(config: ExperimentConfig, method: str) -> Any:
    return config.dynamics if method_of(method).imagines else getattr(config.baselines, method)


def in_steps(config: ExperimentConfig, method: str, steps: int) -> ExperimentConfig:
    """The config with a training of so many steps, its phases and warm-up shortened or stretched with it.

    So a trial is the training in small: a step of it takes, on average, what a step of the training takes.
    """
    own = training_of(config, method)
    if steps == own.steps:
        return config

    whole = int(own.steps)

    def share(of: int) -> int:
        return -(-of * steps // whole)

    changes: dict[str, Any] = {name: share(getattr(own, name)) for name in PHASES if hasattr(own, name)}
    changes["optim"] = replace(own.optim, warmup_steps=share(own.optim.warmup_steps))
    return with_training(config, method, steps=steps, **changes)


def video_config(config: ExperimentConfig, job: VideoJob, world: str) -> ExperimentConfig:
    """What a job trains with: the preset's settings, on clips of the same lengths, drawn alike, for every method.

    `world` is the run of the SAVi.
    """
    own = config.compare_video
    if job.variant:
        config = _with_setting(config, own.vary, job.value)
    if method_of(job.method).imagines:  # whatever the task brings: the two rows are these two
        inverse = replace(config.model.inverse_dynamics, variant=_INVERSE[job.method])
        config = replace(config, model=replace(config.model, inverse_dynamics=inverse))
    config = with_training(config, job.method, seed_frames=own.trained_seed, predicted_frames=own.trained_frames)
    if method_of(job.method).slots:  # those on pixels have no such setting
        config = with_training(config, job.method, from_start=0.0)
    config = _with_context(config, job.method, own.trained_seed + own.trained_frames - 1)
    tests = ",".join(absolute(part.strip()) for part in own.test.split(",") if part)
    config = replace(config, compare_video=replace(own, test=tests))
    tested = 0.0 if own.test else own.tested
    return job_config(config, job, job.trained_as, world, demos="", held_out=0, tested=tested)


def _with_context(config: ExperimentConfig, method: str, frames: int) -> ExperimentConfig:
    """The config with a predictor that attends to as many frames as its training clips show, at most.

    Tests are longer than training clips. A frame at a position that was never trained is predicted badly, and all after
    it (PlaySlot lost 6 dB from the third such frame on); past the context the window slides instead.
    """
    own = training_of(config, method)
    if hasattr(own, "predictor"):
        sizes = replace(own.predictor, context=min(own.predictor.context, frames))
        return with_training(config, method, predictor=sizes)
    if method_of(method).slots:
        sizes = replace(config.model.predictor, context=min(config.model.predictor.context, frames))
        return replace(config, model=replace(config.model, predictor=sizes))
    return config


def video_record(
    job: VideoJob, config: ExperimentConfig, parents: Mapping[str, str], lpips: bool, slots_seconds: float = 0.0
) -> dict[str, Any]:
    """What the job's file says: with its own config, and what names it: fingerprints of the slots and the videos that
    it builds on, and whether there are weights for LPIPS, since scores without it are not those with it. What SAVi took
    names no job: comparisons from before it counted go on.
    """
    own = to_dict(config.compare_video)
    asked = {key: own[key] for key in own if key not in NOT_OF_A_JOB}
    content = {key: value for key, value in asked.items() if key != "test"}  # of a data set the content counts

    def fingerprint(seed: int) -> str:
        result = computed(replace(config, seed=seed))
        result.pop("compare_video", None)
        result["baselines"] = result["baselines"].get(job.method, {})  # another method's are none of this job's
        return fingerprint_of([result, content, dict(parents), lpips])

    return {
        "kind": "video",
        "name": job.name,
        "method": job.method,
        "seed": job.seed,
        "variant": job.variant,
        "out": absolute(str(job.out)),
        "asked": asked,
        "processes": config.compare_video.processes,
        **({"slots_seconds": slots_seconds} if slots_seconds else {}),
        "fingerprint": fingerprint(config.seed),
        "choice": fingerprint(TRIAL_SEED),
        "config": to_dict(config),
    }


def asked_of(record: Mapping[str, Any]) -> CompareVideoConfig:
    return from_dict(CompareVideoConfig, dict(record["asked"]))
