"""Which jobs a comparison has: one for each method, number of demonstrations, of labels, and training seed.

A job is a file, `OUT/jobs/NAME.json`, that says everything; `python -m playslot_rl.recipes.compare_job FILE` runs it,
on any machine that sees the folder, and running it again carries on or does nothing.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compare import LAUNCHERS
from playslot_rl.config.compose import is_pretrained
from playslot_rl.config.methods import METHODS, MethodName, method_stage
from playslot_rl.config.roles import without
from playslot_rl.config.weights import data_roots, is_remote
from playslot_rl.envs import gym_id
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.methods.online.requirements import require_online


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    Attributes:
        method: what is trained.
        demos: demonstrations it learns from; None for a method that acts.
        seed: of the training.
        out: folder of the comparison.
        labels: those of them whose real actions it sees; None for a method that sees all or none, or where the
            comparison has one number for all (`behaviour.labelled_demos`).
        policy_of: labels of the job, with the same demonstrations and seed, whose policy is this one's too; None for
            one that trains its own.
    """

    method: MethodName
    demos: int | None
    seed: int
    out: Path
    labels: int | None = None
    policy_of: int | None = None

    @property
    def name(self) -> str:
        """Such as `lapo-d50-s0`, `lapo-d50-l10-s0` or `dreamer-s0`."""
        demos = "" if self.demos is None else f"-d{self.demos}"
        labels = "" if self.labels is None else f"-l{self.labels}"
        return f"{self.method}{demos}{labels}-s{self.seed}"

    @property
    def file(self) -> Path:
        """What it is told."""
        return self.out / "jobs" / f"{self.name}.json"

    @property
    def run(self) -> Path:
        """The run folder it writes."""
        return self.out / "runs" / self.name

    @property
    def stage(self) -> str:
        """Stage of the run whose checkpoint is the method's."""
        return method_stage(self.method)

    @property
    def model(self) -> Path | None:
        """Run folder of the model of unlabelled videos that it takes, made once for all; None where it takes none."""
        stage = METHODS[self.method].model
        return model_folder(self.out, stage) if stage else None

    @property
    def wave(self) -> int:
        """Those whose policy others take over come first; these would train it again, side by side."""
        return int(self.policy_of is not None)

    @property
    def protocols(self) -> tuple[str, ...]:
        """How it is evaluated."""
        return ("simulation", "imagination") if self.method == "playslot" else ("simulation",)


def jobs(config: ExperimentConfig, out: Path) -> list[Job]:
    """All jobs, in the order in which they run: few demonstrations first, the methods side by side."""
    wanted = config.compare
    offline = [m for m in wanted.methods if not METHODS[m].online]
    online = [m for m in wanted.methods if METHODS[m].online]
    found: list[Job] = []
    for seed in wanted.seeds:
        found += [Job(m, n, seed, out, n) for n in sorted(wanted.labels) for m in offline if METHODS[m].labelled_only]
        for demos in sorted(wanted.demos):
            for method in (m for m in offline if not METHODS[m].labelled_only):
                found += _of_demonstrations(method, demos, seed, out, sorted(wanted.labels))
    return [*found, *(Job(m, None, s, out) for s in wanted.online_seeds or wanted.seeds for m in online)]


def _of_demonstrations(method: MethodName, demos: int, seed: int, out: Path, labels: Sequence[int]) -> list[Job]:
    """One job, or one for each number of labels where the method's policy needs none and serves them all."""
    if not labels or not METHODS[method].decodes:
        return [Job(method, demos, seed, out)]
    return [Job(method, demos, seed, out, n, None if n == labels[0] else labels[0]) for n in labels]


def uses_demos(config: ExperimentConfig) -> bool:
    """Whether a method learns from demonstrations."""
    return any(not METHODS[m].online for m in config.compare.methods)


def uses_slots(config: ExperimentConfig) -> bool:
    """Whether a method builds on a world model."""
    return any(METHODS[m].slots for m in config.compare.methods)


def latent_models(config: ExperimentConfig) -> dict[str, MethodName]:
    """Stages of the models of unlabelled videos that methods build on, and for each of them a method that does."""
    return {METHODS[m].model: m for m in config.compare.methods if METHODS[m].model}


def model_folder(out: Path, stage: str) -> Path:
    """Run folder of such a model in a comparison: `OUT/lapo_world`, `OUT/caddy_world`."""
    return out / f"{stage.removesuffix('_model')}_world"


def check_comparison(config: ExperimentConfig) -> None:
    """Refuse what cannot be compared, before anything is computed.

    Raises:
        ConfigError: an environment without simulator, or without dense reward for a method that acts; a launcher that
            is not installed; the shipped world model of another task.
        CheckpointError: `run` is no finished world model.
    """
    env, wanted = config.env, config.compare
    gym_id(env.name)
    for method in (m for m in wanted.methods if METHODS[m].online):
        require_online(config, getattr(config.baselines, method), method)
    weights = config.baselines.resnet_oracle.weights
    named = weights in ("auto", "download", "scratch")
    if {"resnet_oracle", "resnet_bc"} & {*wanted.methods} and not named and not Path(weights).is_file():
        raise ConfigError(
            f"baselines.resnet_oracle.weights: got {weights}, expected a file, auto, download or scratch: check it"
        )
    if wanted.launcher and not _installed(LAUNCHERS[wanted.launcher]):
        raise ConfigError(
            f"hydra.launcher: got {wanted.launcher}, expected an installed launcher: install it by `uv pip install -e "
            "'.[launchers]'`"
        )
    if uses_slots(config) and config.run:
        from playslot_rl.storage.checkpoints import require_config
        from playslot_rl.training.runs import world_model_checkpoints

        for checkpoint in world_model_checkpoints(config.run).values():
            require_config(checkpoint, {"env": {"image_size": env.image_size, "action_dim": env.action_dim}})
            trained_on = checkpoint.config.get("env", {}).get("name")
            if trained_on != env.name:
                raise CheckpointError(
                    f"run={config.run}: got a world model of env={trained_on}, expected env={env.name}: leave run= "
                    "out to train one"
                )


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # of the package it is in
        return False


def check_demos(config: ExperimentConfig, episodes: int, where: str) -> None:
    """Refuse more demonstrations than there are.

    Raises:
        ConfigError: there are fewer.
    """
    most = max(config.compare.demos)
    if most > episodes:
        raise ConfigError(
            f"demos: got {most}, expected at most the {episodes} demonstrations of {where}: lower it or collect more"
        )


def job_config(config: ExperimentConfig, job: Job, world: str) -> ExperimentConfig:
    """What a job trains with.

    Labels are the job's, else `behaviour.labelled_demos` or, with fewer demonstrations, all of them. PlaySlot's own
    oracle and the references of each evaluation are left out: the slot oracle is a method, and the references run once.
    Paths are absolute, so that a job runs from any folder.

    Args:
        config: of the comparison, with `data` complete.
        job: which one.
        world: run folder of the world model, or `pretrained`.
    """
    labelled = job.labels or min(config.behaviour.labelled_demos, job.demos or config.behaviour.labelled_demos)
    policy = "" if job.policy_of is None else absolute(str(replace(job, labels=job.policy_of).run))
    own = {}
    if job.model is not None:
        own = {job.method: replace(getattr(config.baselines, job.method), world=absolute(str(job.model)))}
    data = replace(
        config.data,
        root=absolute_roots(config.data.root),
        demos=absolute(config.data.demos),
        cache=absolute(config.data.cache),
        draw=None if METHODS[job.method].online else job.seed,
    )
    return replace(
        config,
        method=job.method,
        demos=job.demos,
        seed=job.seed,
        data=data,
        out=absolute(str(job.run)),
        run=absolute(world) if METHODS[job.method].slots else "",
        protocol="simulation",
        behaviour=replace(config.behaviour, labelled_demos=labelled, oracle=False, policy_from=policy),
        baselines=replace(config.baselines, **own),
        evaluation=replace(config.evaluation, references=False),
        logging=replace(config.logging, progress=False),
    )


def absolute(path: str) -> str:
    """A path from the root; nothing, shipped models (`pretrained/ENV`) and addresses on the Hub as they are."""
    return path if not path or is_pretrained(path) or is_remote(path) else str(Path(path).expanduser().resolve())


def absolute_roots(text: str) -> str:
    """`data.root` with every folder from the root; weights stay."""
    return ",".join(root._replace(path=absolute(root.path)).text for root in data_roots(text))


def job_record(job: Job, config: ExperimentConfig, parents: Mapping[str, str]) -> dict[str, Any]:
    """What the job's file says.

    Args:
        job: which one.
        config: its own (`job_config`).
        parents: fingerprints of the weights and demonstrations it builds on.
    """
    values = to_dict(config)
    result = without(config, "machine")  # of data and parents the content counts
    result["baselines"] = result["baselines"].get(job.stage, {})  # another method's settings are none of this job's
    if result["model"]["predictor"]["kind"] == "cocvp":
        del result["model"]["predictor"]["kind"]  # jobs from before there was a choice are the same jobs
    identity = json.dumps([result, config.compare.evaluation_seed, dict(parents)], sort_keys=True)
    return {
        "name": job.name,
        "method": job.method,
        "demos": job.demos,
        "labels": job.labels,
        "seed": job.seed,
        "evaluation_seed": config.compare.evaluation_seed,
        "protocols": list(job.protocols),
        "stage": job.stage,
        "processes": 1 if METHODS[job.method].online else config.compare.processes,
        "fingerprint": hashlib.sha256(identity.encode()).hexdigest()[:16],
        "config": values,
    }
