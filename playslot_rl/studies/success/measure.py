"""Success in simulation and in imagination as the measure of a study: `playslot compare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import CompareConfig, ExperimentConfig, from_dict
from playslot_rl.envs import gym_id
from playslot_rl.errors import CheckpointError
from playslot_rl.evaluation.seeds import held_out_seeds
from playslot_rl.evaluation.success import DEFAULT_EPISODES, run_references
from playslot_rl.methods.training import check_method
from playslot_rl.runs import Run
from playslot_rl.storage.checkpoints import require_config
from playslot_rl.studies.launch import Status
from playslot_rl.studies.several import Commands, train
from playslot_rl.studies.study import Record
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.studies.success.jobs import (
    SuccessJob,
    success_config,
    success_jobs,
    success_record,
    uses_slots,
)
from playslot_rl.studies.success.page import success_page
from playslot_rl.studies.success.rows import job_rows, summarise
from playslot_rl.studies.success.shared import Shared, check_data, prepare_shared


class SuccessMeasure:
    """See `playslot_rl.studies.study.Measure`.

    Args:
        config: with `out`; `run` names a world model, or none.
        commands: by which what jobs share is trained.
    """

    command = "compare"
    name = "comparison"
    unit = "jobs"
    page = staticmethod(success_page)
    figure = staticmethod(success_figure)

    def __init__(self, config: ExperimentConfig, commands: Commands) -> None:
        self.config = replace(config, episodes=config.episodes or DEFAULT_EPISODES)
        self._commands, self._references, self._shared = commands, dict[str, Any](), dict[str, Any]()

    @property
    def launcher(self) -> tuple[str, Sequence[str]]:
        return self.config.compare.launcher, self.config.compare.hydra

    def check(self) -> None:
        check_success(self.config)
        self.config = check_data(self.config)

    def prepare(self) -> Mapping[SuccessJob, Record]:
        self.config = config = prepare_shared(self.config, self._commands)
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
    def run(record: Record, commands: Commands) -> None:
        config = from_dict(ExperimentConfig, record["config"])
        train("train-baseline", config, int(record["processes"]), commands)
        own = replace(config, run=config.out, out="", seed=int(record["evaluation_seed"]))
        for protocol in record["protocols"]:
            commands["evaluate"](replace(own, protocol=protocol))

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
    """Refuse what cannot be compared, before anything is computed.

    Raises:
        ConfigError: an environment without simulator, or without dense reward for a method that acts; weights that
            are not there.
        CheckpointError: `run` is no finished world model, or one of another task.
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
    """What the random policy and the scripted expert do in the evaluation episodes, run or read.

    Raises:
        ConfigError: an evaluation seed that a training data set holds.
    """
    seeds = held_out_seeds(config, config.compare.evaluation_seed, config.episodes or 0)
    with TaskPool(config.env, config.render) as pool:
        found = run_references(None, config, seeds, pool, cache=Path(config.out) / "references.json")
    return {name: found[name] for name in ("random", "expert")}
