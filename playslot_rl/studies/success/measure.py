"""Success in simulation and in imagination as the measure of a study: `playslot compare`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import CompareConfig, ExperimentConfig, from_dict
from playslot_rl.config.methods import METHODS
from playslot_rl.envs import gym_id
from playslot_rl.errors import CheckpointError
from playslot_rl.evaluation.held_out import held_out_seeds
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.evaluation.success import DEFAULT_EPISODES, run_references
from playslot_rl.methods.training import check_method
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.storage.checkpoints import require_config
from playslot_rl.studies.launch import Status, train
from playslot_rl.studies.study import Evaluate, Record, count_parameters
from playslot_rl.studies.success.jobs import (
    Shared,
    SuccessJob,
    check_data,
    prepare_shared,
    success_config,
    success_jobs,
    success_record,
    uses_slots,
)
from playslot_rl.studies.success.page import success_figure, success_page


def job_rows(job: SuccessJob, frame_skip: int, status: Status) -> list[dict[str, Any]]:
    """One row for each protocol of a job, finished or not; null where there is nothing to say.

    Of its keys, `env_steps` are `frame_skip` times the `agent_steps`, `samples` optimiser steps times batch, `ci95` is
    Wilson's, `kept_rows` the share of the demonstrations' rows that trimming left, and `curve` an online method's
    learning curve, with both kinds of steps.
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
        rows.append(
            {
                "name": job.name,
                "method": job.method,
                "title": job.title,
                "protocol": protocol,
                "demos": job.demos,
                "labels": job.labels,
                "seed": job.seed,
                "status": status.status,
                "error": status.error or None,
                **of_training,
                "success_rate": rate,
                "successes": None if rate is None else round(rate * info["episodes"]),
                "episodes": info.get("episodes"),
                "ci95": info.get("ci95"),
                "mean_steps_to_success": info.get("mean_steps_to_success"),
                "train_seconds": meta.get("seconds", 0) + own_model_seconds(job) if meta else None,
                "evaluation_seconds": info.get("wall_seconds"),
                "parameters": count_parameters(Run(job.run), job.stage) if meta else None,
                "pretraining": meta.get("pretraining"),
                "kept_rows": meta.get("kept_rows"),
                "curve": learning_curve(job, frame_skip) if job.online else None,
            }
        )
    return rows


def own_model_seconds(job: SuccessJob) -> float:
    """Training of the model of videos that a job makes for itself, because its labels count in it."""
    model = METHODS[job.method].model
    meta = json_or_nothing(job.run / model.name / "checkpoint" / "meta.json") if model and model.labels else {}
    return float(meta.get("seconds", 0)) if meta.get("labelled", "none") != "none" else 0


def learning_curve(job: SuccessJob, frame_skip: int) -> list[dict[str, Any]] | None:
    """Rows of `RUN/METHOD/curve.json`, there before the job is done too; None without one."""
    rows = json_or_nothing(job.run / job.stage / "curve.json").get("rows") or []
    return [
        {**row, "agent_steps": row["env_steps"], "env_steps": row["env_steps"] * frame_skip} for row in rows
    ] or None


def count_samples(job: SuccessJob, meta: Mapping[str, Any]) -> int | None:
    """Examples a method's policy was trained on, repeats included: optimiser steps times batch."""
    config = json_or_nothing(job.run / job.stage / "checkpoint" / "config.json").get(job.stage, {})
    batch = config.get("batch_size", config.get("policy", {}).get("batch_size"))
    return None if batch is None or job.online or not meta else int(meta.get("steps", 0)) * int(batch)


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of finished jobs, pooled over training seeds.

    Steps, seconds and `success_rate` are means over the seeds, `lowest` and `highest` rates of a seed.

    `ci95` is Wilson's interval of that mean over the episodes of one seed: all seeds play the same ones, so that
    pooling them would count an episode that is easy, or hard, for all of them several times.
    """
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["success_rate"] is not None:
            groups.setdefault((row["method"], row["protocol"], row["demos"], row["labels"]), []).append(row)
    summary = []
    for (method, protocol, demos, labels), group in groups.items():
        rates = [r["success_rate"] for r in group]
        summary.append(
            {
                "method": method,
                "title": group[0]["title"],
                "protocol": protocol,
                "demos": demos,
                "labels": labels,
                **{key: _mean(r[key] for r in group) for key in ("agent_steps", "env_steps", "train_seconds")},
                "seeds": sorted(r["seed"] for r in group),
                "success_rate": sum(rates) / len(rates),
                "ci95": list(wilson(sum(r["successes"] for r in group) / len(group), group[0]["episodes"])),
                "lowest": min(rates),
                "highest": max(rates),
                "episodes": sum(r["episodes"] for r in group),
                "labelled_demos": group[0]["labelled_demos"],
            }
        )
    return summary


def _mean(values: Iterable[float | None]) -> int | None:
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known)) if known else None


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
        check_success(self.config)
        self.config = check_data(self.config)

    def prepare(self) -> Mapping[SuccessJob, Record]:
        self.config = config = prepare_shared(self.config)
        wanted, shared = config.compare, Shared(config)
        plain = replace(
            config, compare=CompareConfig(evaluation_seed=wanted.evaluation_seed, processes=wanted.processes)
        )
        found = {
            job: success_record(job, success_config(plain, job, config.run), shared.parents(job))
            for job in success_jobs(config, Path(config.out))
        }
        self._references, self._shared = _references(config), shared.plain()
        return found

    @staticmethod
    def run(record: Record, evaluate: Evaluate) -> None:
        config = from_dict(ExperimentConfig, record["config"])
        train("train-baseline", config, int(record["processes"]))
        own = replace(config, run=config.out, out="", seed=int(record["evaluation_seed"]))
        for protocol in record["protocols"]:
            evaluate(replace(own, protocol=protocol))

    def rows(self, job: SuccessJob, status: Status) -> list[dict[str, Any]]:
        return job_rows(job, self.config.env.frame_skip, status)

    def said(self, rows: Sequence[Mapping[str, Any]]) -> str:
        known = [row for row in rows if row["success_rate"] is not None]
        return ", ".join(f"{100 * row['success_rate']:.0f} % in {row['protocol']}" for row in known)

    def result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        config, own = self.config, self.config.compare
        return {
            "methods": list(own.methods),
            "demos": list(own.demos),
            "labels": list(own.labels),
            "seeds": list(own.seeds),
            "episodes": config.episodes,
            "evaluation_seed": own.evaluation_seed,
            "max_steps": config.env.max_steps,
            "jobs": len({row["name"] for row in rows}),
            "summary": summarise(rows),
            "references": self._references,
            "rows": rows,
            **self._shared,
            "learn_from_demos": config.collect.learn_from_demos,
            "frame_skip": config.env.frame_skip,
            "threads": config.threads,
        }

    def sheets(self) -> Mapping[str, bytes]:
        return {}


def check_success(config: ExperimentConfig) -> None:
    """Refuse what cannot be compared, before anything is computed: a ConfigError for an environment without simulator,
    or without dense reward for a method that acts, or weights that are not there; a CheckpointError where `run` is no
    finished world model, or one of another task.
    """
    env = config.env
    gym_id(env.name)
    for method in config.compare.methods:
        check_method(config, method)
    if not uses_slots(config) or not config.run:
        return
    for checkpoint in Run.open(config.run).world_stages.values():
        require_config(checkpoint, {"env": {"image_size": env.image_size, "action_dim": env.action_dim}})
        trained_on = checkpoint.config.get("env", {}).get("name")
        if trained_on != env.name:
            raise CheckpointError(
                f"run={config.run}: got a world model of env={trained_on}, expected env={env.name}: leave run= "
                "out to train one"
            )


def _references(config: ExperimentConfig) -> dict[str, dict[str, Any]]:
    """What the random policy and the scripted expert do in the evaluation episodes, run or read; a ConfigError for an
    evaluation seed that a training data set holds.
    """
    seeds = held_out_seeds(config, config.compare.evaluation_seed, config.episodes or 0)
    with TaskPool(config.env, config.render) as pool:
        found = run_references(None, config, seeds, pool, cache=Path(config.out) / "references.json")
    return {name: found[name] for name in ("random", "expert")}
