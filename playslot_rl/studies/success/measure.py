"""Success in simulation and in imagination as the measure of a study: `playslot compare`."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import CompareConfig, EnvConfig, ExperimentConfig, from_dict
from playslot_rl.config.methods import METHODS, require_told
from playslot_rl.config.plain import flatten
from playslot_rl.envs import RECORDED, check_task
from playslot_rl.errors import CheckpointError, ConfigError, OutputError
from playslot_rl.evaluation.actions import error_text, require_offline
from playslot_rl.evaluation.before import measured_before
from playslot_rl.evaluation.held_out import held_out_seeds
from playslot_rl.evaluation.success import DEFAULT_EPISODES, run_references
from playslot_rl.methods.training import check_method
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.storage.checkpoints import StageCheckpoint, read_stage, require_config
from playslot_rl.storage.resume import first_difference
from playslot_rl.studies import launch
from playslot_rl.studies.launch import Status, train
from playslot_rl.studies.study import Evaluate, Record, count_parameters, made_by
from playslot_rl.studies.success.block import block_of, with_block
from playslot_rl.studies.success.errors import ERRORS, summarise_errors
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.jobs import (
    Shared,
    SuccessJob,
    check_data,
    latent_models,
    model_named,
    prepare_shared,
    success_config,
    success_jobs,
    success_record,
    uses_demos,
    uses_slots,
    world_parts,
    world_run,
    world_runs,
)
from playslot_rl.studies.success.page import success_page
from playslot_rl.studies.success.summary import differences, summarise
from playslot_rl.studies.success.task_table import joint_table
from playslot_rl.training.record import StageRecord


def job_rows(job: SuccessJob, frame_skip: int, status: Status) -> list[dict[str, Any]]:
    """One row for each protocol of a job, finished or not; null where there is nothing to say.

    Of its keys, `outcomes` has a digit for each episode, 1 for a success, `commits` and `processors` are those that
    trained and measured, `env_steps` are environment steps, `frame_skip` times the `agent_steps` (which `meta.json` and
    `curve.json` of a run call `env_steps`), `samples` optimiser steps times batch, `ci95` is Wilson's, `kept_rows` the
    share of the demonstrations' rows that trimming left, and `curve` an online method's learning curve, with both kinds
    of steps.
    """
    done = status.status == "done"
    meta = json_or_nothing(job.run / job.stage / "checkpoint" / "meta.json") if done else {}
    steps = meta.get("env_steps")
    of_training = {
        "labelled_demos": None if job.online else meta.get("labelled_demos"),
        "agent_steps": steps,
        "env_steps": None if steps is None else steps * frame_skip,
        "samples": count_samples(job, meta),
    }
    rows = []
    for protocol in job.protocols:
        info = json_or_nothing(job.run / "evaluation" / protocol / "eval_info.json") if done else {}
        rate = info.get("success_rate")
        others: dict[str, Any] = {key: info[key] for key in ("mean_return", *ERRORS) if key in info}
        rows.append(
            {
                "name": job.name,
                "method": job.method,
                "title": job.title,
                "protocol": protocol,
                "demos": job.demos,
                "labels": job.labels,
                "world": job.world,
                "seed": job.seed,
                "status": status.status,
                "error": status.error or None,
                **of_training,
                "success_rate": rate,
                "successes": None if rate is None else round(rate * info["episodes"]),
                "episodes": info.get("episodes"),
                "outcomes": None if rate is None else "".join(str(int(e["success"])) for e in info["per_episode"]),
                "ci95": info.get("ci95"),
                **others,
                "mean_steps_to_success": info.get("mean_steps_to_success"),
                "train_seconds": meta.get("seconds", 0) + own_model_seconds(job) if meta else None,
                "evaluation_seconds": info.get("wall_seconds"),
                "parameters": count_parameters(Run(job.run), job.stage) if meta else None,
                "pretraining": meta.get("pretraining"),
                "kept_rows": meta.get("kept_rows"),
                "curve": learning_curve(job, frame_skip) if job.online else None,
                **made_by(meta, status),
            }
        )
    return rows


def own_model_seconds(job: SuccessJob) -> float:
    """Training of the model of videos that a job makes for itself, because its labels count in it."""
    model = METHODS[job.method].model
    meta = json_or_nothing(job.run / model.name / "checkpoint" / "meta.json") if model and model.labels else {}
    return float(meta.get("seconds", 0)) if meta.get("labelled", "none") != "none" else 0


def learning_curve(job: SuccessJob, frame_skip: int) -> list[dict[str, Any]] | None:
    """Rows of `RUN/METHOD/curve.json`, whose `env_steps` are agent steps, with both kinds by their names; there before
    the job is done, too; None without one."""
    rows = json_or_nothing(job.run / job.stage / "curve.json").get("rows") or []
    return [
        {**row, "agent_steps": row["env_steps"], "env_steps": row["env_steps"] * frame_skip} for row in rows
    ] or None


def count_samples(job: SuccessJob, meta: Mapping[str, Any]) -> int | None:
    """Examples a method's policy was trained on, repeats included: optimiser steps times batch."""
    config = json_or_nothing(job.run / job.stage / "checkpoint" / "config.json").get(job.stage, {})
    batch = config.get("batch_size", config.get("policy", {}).get("batch_size"))
    return None if batch is None or job.online or not meta else int(meta.get("steps", 0)) * int(batch)


class SuccessMeasure:
    """See `playslot_rl.studies.study.Measure`; the config has `out`, and `run` names a world model, or none."""

    command = "compare"
    name = "comparison"
    unit = "jobs"
    page = staticmethod(success_page)
    figure = staticmethod(success_figure)

    def __init__(self, config: ExperimentConfig) -> None:
        self.config = replace(config, episodes=config.episodes or DEFAULT_EPISODES)
        self.launcher: tuple[str, Sequence[str]] = (config.compare.launcher, config.compare.hydra)
        self._references, self._shared = dict[str, Any](), dict[str, Any]()

    def check(self) -> None:
        if launch.of_tasks(out := Path(self.config.out)):
            raise OutputError(f"out={out}: got comparisons of several tasks, by envs=, expected none: choose another")
        check_success(self.config)
        self.config = check_data(self.config)
        require_same_trainings(self.config)

    def prepare(self) -> Mapping[SuccessJob, Record]:
        self.config = config = prepare_shared(with_block(self.config))
        wanted, shared = config.compare, Shared(config)
        own = CompareConfig(evaluation_seed=wanted.evaluation_seed, block=wanted.block, processes=wanted.processes)
        plain, runs = replace(config, compare=own), world_runs(config)
        found = {
            job: success_record(
                job, success_config(plain, job, runs[min(job.world, len(runs) - 1)]), shared.parents(job)
            )
            for job in success_jobs(config, Path(config.out))
        }
        self._references, self._shared = _references(config), shared.plain()
        return found

    @staticmethod
    def run(record: Record, evaluate: Evaluate) -> None:
        config = from_dict(ExperimentConfig, record["config"])
        train("train-baseline", config, int(record["processes"]))
        for measured in _evaluations(record, config):
            evaluate(measured)

    @staticmethod
    def agrees(record: Record) -> bool:
        try:
            config = from_dict(ExperimentConfig, record["config"])
            return all(measured_before(measured) is not None for measured in _evaluations(record, config))
        except CheckpointError:  # of a policy that is gone
            return False

    def rows(self, job: SuccessJob, status: Status) -> list[dict[str, Any]]:
        return job_rows(job, self.config.acting.frame_skip, status)

    def said(self, rows: Sequence[Mapping[str, Any]]) -> str:
        if any("mae" in row for row in rows):
            return ", ".join(f"error {error_text(row)}" for row in rows if "mae" in row)
        known = [row for row in rows if row["success_rate"] is not None]
        returns = [f"return {row['mean_return']:.2f} in {row['protocol']}" for row in rows if "mean_return" in row]
        return ", ".join([*(f"{100 * row['success_rate']:.0f} % in {row['protocol']}" for row in known), *returns])

    def result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        config, own = self.config, self.config.compare
        recorded = config.env.name in RECORDED
        summary = summarise_errors(rows) if recorded else summarise(rows)
        reference = own.reference if own.reference in own.methods else None
        others, here = task_results(config), {"env": config.env.full_name, "rows": rows, "summary": summary}
        return {
            "methods": list(own.methods),
            "demos": list(own.demos),
            "labels": list(own.labels),
            "seeds": list(own.seeds),
            "episodes": config.episodes,
            "evaluation_seed": own.evaluation_seed,
            "block": block_of(config),
            "videos": list(own.videos),
            "worlds": own.worlds,
            "max_steps": config.acting.max_steps,
            "jobs": len({row["name"] for row in rows}),
            "summary": summary,
            "reference": reference,
            "differences": differences(rows, own.reference),
            "measure": "actions" if recorded else "success",
            "held_out": config.data.held_out,
            "across_tasks": joint_table([here, *others], reference) if others else None,
            "references": self._references,
            "rows": rows,
            **self._shared,
            "learn_from_demos": config.collect.learn_from_demos,
            "frame_skip": config.acting.frame_skip,
            "threads": config.threads,
        }

    def sheets(self) -> Mapping[str, bytes]:
        return {}


def _evaluations(record: Record, config: ExperimentConfig) -> list[ExperimentConfig]:
    """What a job evaluates once it is trained, a config for each protocol."""
    own = replace(config, run=config.out, out="", seed=int(record["evaluation_seed"]))
    return [replace(own, protocol=protocol) for protocol in record["protocols"]]


def check_success(config: ExperimentConfig) -> None:
    """Refuse what cannot be compared, before anything is computed: a ConfigError for an environment without simulator,
    or without dense reward for a method that acts, or weights that are not there; a CheckpointError where `run` is no
    finished world model, or one of another task.
    """
    env = config.env
    if env.name in RECORDED:
        check_recorded(config)
    else:
        # Goal images are where the expert ends.
        check_task(env, expert=config.model.policy.goal or (not config.data.demos and uses_demos(config)))
    for method in config.compare.methods:
        require_told(config, method)
        check_method(config, method)
    task_results(config, [env.full_name])
    for stage in latent_models(config):
        if named := model_named(config, stage):
            Run.open(named).own(stage)
    for run in world_runs(config) if uses_slots(config) else ():
        for checkpoint in map(Run.open(run).stage, world_parts(config.compare.methods)) if run else ():
            sizes = ("image_size",) if env.name in RECORDED else ("image_size", "action_dim")  # videos have no actions
            require_config(checkpoint, {"env": {key: getattr(env, key) for key in sizes}})
            trained = checkpoint.group(EnvConfig, "env")
            if not trained.serves(env):
                raise CheckpointError(
                    f"run={run}: got a world model of {' '.join(trained.typed)}, expected {' '.join(env.typed)}: "
                    "leave it out to train one"
                )


def require_same_trainings(config: ExperimentConfig) -> None:
    """Refuse settings, or a world model, with which finished trainings of this folder were not made, by a ConfigError:
    each job would, one after the other, and what is there would be lost from the result.
    """
    prints = functools.cache(lambda run: _world_prints(run, world_parts(config.compare.methods)))
    for job in success_jobs(config, Path(config.out)):
        path = job.run / job.stage / "checkpoint"
        if not (path / "meta.json").is_file():
            continue
        try:
            done = read_stage(path, job.stage)
        except CheckpointError:  # damaged: the job says so
            continue
        run = world_run(config, job.world)
        found = _other_settings(config, job, done) or _other_world(job, run, prints(run), done)
        if found is not None:
            key, known, got = found
            raise ConfigError(
                f"{key}: got {got}, expected {known}, with which {job.name} of {config.out} was trained: "
                f"leave {key} as it was, or use another out="
            )


def _other_settings(config: ExperimentConfig, job: SuccessJob, done: StageCheckpoint) -> tuple[str, Any, Any] | None:
    """The first setting that is not as a job was trained with: its key, as it was and as it is. Of the sizes, which the
    world model decides, those that its file, too, says were otherwise.
    """
    spec, own = METHODS[job.method].last, success_config(config, job, "")
    wanted, stored = StageRecord(spec, job.run, own).finishes(), flatten(done.config)
    sizes = flatten({"model": wanted.pop("model", {})})
    found = first_difference({key: stored[key] for key in flatten(wanted) if key in stored}, wanted, spec.typed)
    try:
        before = from_dict(ExperimentConfig, json_or_nothing(job.file)["config"])
    except (KeyError, ValueError):  # none, or of an earlier version
        return found
    asked = flatten({"model": StageRecord(spec, job.run, before).finishes().get("model", {})})
    for key, value in sizes.items():
        if asked.get(key) != value and asked.get(key) == stored.get(key):
            found = found or (key, stored[key], value)
    kept = before.data.held_out, config.data.held_out
    if config.data.demos and not job.online and kept[0] != kept[1]:  # what is recorded here says itself how many
        found = found or ("data.held_out", *kept)
    return found


def _other_world(
    job: SuccessJob, run: str, prints: Mapping[str, str], done: StageCheckpoint
) -> tuple[str, str, str] | None:
    """`run`, where a finished job built on another world model than the one of these fingerprints: that one, and it."""
    parents = done.meta.get("parents", {})
    for name in METHODS[job.method].world:
        if parents.get(name, prints[name]) != prints[name]:
            return "run", f"a world model with {name} {parents[name]}", f"{run} with {prints[name]}"
    return None


def _world_prints(run: str, stages: Sequence[str]) -> dict[str, str]:
    """Fingerprints of a world model's stages; "none yet" where one is to be trained."""
    found = dict.fromkeys(stages, "none yet")
    for name in stages:
        with suppress(CheckpointError):
            found[name] = Run.open(run).stage(name).fingerprint
    return found


def check_recorded(config: ExperimentConfig) -> None:
    """Refuse, by a ConfigError, what cannot be compared without a simulator."""
    if not (config.data.demos or config.data.root):
        raise ConfigError(f"data.demos: got nothing with env={config.env.name}, expected a data set with actions")
    if config.compare.tasks or config.compare.envs:
        raise ConfigError(f"compare.tasks: got some with env={config.env.name}, expected none: errors have units")
    for method in config.compare.methods:
        require_offline(method)


def task_results(config: ExperimentConfig, own: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Comparisons of other tasks; a ConfigError where a folder holds no finished one of this version, or one of a task
    that is there already, among them or in `own`.
    """
    folders = [Path(part.strip()) for part in config.compare.tasks.split(",") if part.strip()]
    results, tasks = [json_or_nothing(folder / "comparison.json") for folder in folders], list(own)
    for folder, result in zip(folders, results, strict=True):
        if not all("outcomes" in row for row in result.get("rows") or [{}]):
            raise ConfigError(
                f"compare.tasks: got {folder} without outcomes in comparison.json, expected a comparison's folder: run "
                "its command again, which computes nothing that is done"
            )
        if result["env"] in tasks:
            raise ConfigError(
                f"compare.tasks: got {folder} of {result['env']}, which is compared already, expected each task once: "
                "leave one of them out"
            )
        tasks.append(result["env"])
    return results


def _references(config: ExperimentConfig) -> dict[str, dict[str, Any]]:
    """What the random policy and the scripted expert do in the evaluation episodes, run or read; a ConfigError for an
    evaluation seed that a training data set holds.
    """
    if config.env.name in RECORDED:
        return {}
    seeds = held_out_seeds(config, config.compare.evaluation_seed, config.episodes or 0)
    with TaskPool(config.acting, config.render) as pool:
        found = run_references(None, config, seeds, pool, cache=Path(config.out) / "references.json")
    return {name: found[name] for name in ("random", "expert")}
