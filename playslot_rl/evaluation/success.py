"""Success in simulation (closed loop) and in imagination (open loop), on a fixed list of seeds, one episode each; that
of the expert's videos replayed through the latents; and that of the references on the same seeds: random actions, the
scripted expert, and the slot oracle.

TorchRL's `Evaluator` counts the first N *finished* episodes, which favours short ones and overstates success; the plain
loop here runs each seed once. That it acts as the TorchRL environments do is tested.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch

from playslot_rl.acting.actor import Actor, ExpertActor, RandomActor
from playslot_rl.acting.agent import ImaginationActor, ReplayActor, oracle_actor, perform, playslot_actor, show_goals
from playslot_rl.acting.episodes import Outcome, TaskPool, run_episodes
from playslot_rl.config import EnvConfig, ExperimentConfig, to_dict
from playslot_rl.config.methods import METHODS, method_stage
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.evaluation.held_out import check_disjoint, first_seed, held_out_seeds, training_seeds
from playslot_rl.evaluation.intervals import wilson
from playslot_rl.runtime.devices import processor
from playslot_rl.runtime.threads import available_cores
from playslot_rl.storage.atomic import write_json
from playslot_rl.storage.checkpoints import source_commit
from playslot_rl.world_model import Agent

POLICY_PROTOCOLS: Final[tuple[Literal["simulation", "imagination"], ...]] = ("simulation", "imagination")
PROTOCOLS = (*POLICY_PROTOCOLS, "replay")
REFERENCES = ("random", "expert", "slot_oracle")
DEFAULT_EPISODES = 50
NOTHING: Final[dict[str, Any]] = {"success_rate": None, "ci95": None, "mean_steps_to_success": None}
"""Of an actor that there is not, or a task without success."""


@dataclass(frozen=True)
class RunFacts:
    """What the result file says about the run it measures.

    Attributes:
        demos, labelled_demos: demonstrations whose videos, and whose real actions, the policy was trained on; None if
            the run does not say.
        fingerprints: weights by stage.
        trained_at: commit of the training.
        extra: what the method's checkpoint says of its own (`pretraining`, `env_steps`, which are
            agent steps).
    """

    demos: int | None = None
    labelled_demos: int | None = None
    fingerprints: dict[str, str] = field(default_factory=dict)
    trained_at: str = ""
    method: str = "playslot"
    extra: dict[str, Any] = field(default_factory=dict)


def run_facts(run: Path, method: str = "playslot") -> RunFacts:
    """Read the meta file of a method's stage; a CheckpointError where there is no trained policy,
    or it cannot be read.
    """
    stage = method_stage(method)
    path = run / stage / "checkpoint" / "meta.json"
    if not path.is_file():
        own = METHODS[method].imagines
        command = f"train-policy run={run}" if own else f"train-baseline method={method} out={run}"
        raise CheckpointError(f"{run}: got no {stage}/checkpoint, expected a trained policy; run `playslot {command}`")
    try:
        meta: dict[str, Any] = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path}: got {error}, expected JSON; train the policy again") from error
    prints = {str(k): str(v) for k, v in meta.get("parents", {}).items()}
    prints[stage] = str(meta.get("fingerprint", ""))
    return RunFacts(
        demos=meta.get("demos"),
        labelled_demos=meta.get("labelled_demos"),
        fingerprints=prints,
        trained_at=str(meta.get("commit", "")),
        method=method,
        extra={name: meta[name] for name in ("pretraining", "env_steps") if name in meta},
    )


def evaluate(
    agent: Agent,
    config: ExperimentConfig,
    protocol: str,
    episodes: int,
    seed: int,
    *,
    facts: RunFacts | None = None,
    run: Path | None = None,
    pool: TaskPool | None = None,
) -> dict[str, Any]:
    """Measure an agent, whose slot oracle is a reference.

    Args:
        config: environment, renderer, `evaluation`, and the data sets whose seeds must not come up.
        protocol: `simulation` (closed loop) or `imagination` (open loop: one frame is parsed, policy and cOCVP unfold
            `max_steps` steps in latent space, and the decoded actions are then executed), or `replay` (open loop: the
            latents are those of the expert's video of the same episode; the policy is not asked).
        seed: selects the block of evaluation seeds.
        run: its folder; what the references do is kept under `RUN/evaluation`.
        pool: environments to use and leave open; None makes and closes its own.

    Returns:
        `protocol`, `episodes`, `seeds`, `success_rate` (0 to 1), `ci95` (Wilson), `mean_steps_to_success` (agent
        steps), `labelled_demos`, `demos`, `references` (`random`, `expert`, `slot_oracle`: closed-loop), and extras.

    Raises:
        ConfigError: unknown protocol, or a seed that a training data set holds.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"protocol: got {protocol!r}, expected one of {', '.join(PROTOCOLS)}")
    agent.eval()
    oracle = None if agent.oracle is None else oracle_actor(agent)
    with TaskPool(config.acting, config.render) as stage:
        actor: Actor
        if protocol == "simulation":
            actor = playslot_actor(agent)
        elif protocol == "imagination":
            actor = ImaginationActor(agent, config.acting.max_steps)
        else:
            actor = ReplayActor(agent, partial(perform, stage))
        return measure(
            actor, config, protocol, episodes, seed, facts=facts or RunFacts(), run=run, pool=pool, oracle=oracle
        )


def measure(
    actor: Actor,
    config: ExperimentConfig,
    protocol: str,
    episodes: int,
    seed: int,
    *,
    facts: RunFacts,
    run: Path | None = None,
    pool: TaskPool | None = None,
    oracle: Actor | None = None,
) -> dict[str, Any]:
    """Measure any actor in evaluation mode, as `evaluate` does; null values of the slot oracle without an `oracle`."""
    seeds = held_out_seeds(config, seed, episodes, run)
    begin = time.perf_counter()
    own = TaskPool(config.acting, config.render) if pool is None else contextlib.nullcontext(pool)
    with own as used, TaskPool(config.acting, config.render) as stage:
        for one in (actor, oracle):
            show_goals(one, stage)
        outcome = run_episodes(used, actor, seeds)
        wall = time.perf_counter() - begin
        references: dict[str, dict[str, Any]] = {n: {"success_rate": None, "ci95": None} for n in REFERENCES}
        if config.evaluation.references:
            prints = facts.fingerprints if "policy" in facts.fingerprints else {}
            weights = "-".join(prints[k] for k in ("slots", "policy") if prints.get(k))
            cache = None if run is None else run / "evaluation" / "references.json"
            references = run_references(oracle, config, seeds, used, weights, cache)
    played = [e.seed for e in outcome]
    check_disjoint(played, training_seeds(config, run))  # a redrawn episode has another seed
    return {
        "method": facts.method,
        "protocol": protocol,
        "episodes": episodes,
        "seeds": played,
        **summary(outcome, config.acting),
        "labelled_demos": facts.labelled_demos,
        "demos": facts.demos,
        **facts.extra,
        "references": references,
        "references_protocol": "simulation (closed loop), on the same seeds",
        "max_steps": config.acting.max_steps,
        "redrawn": sum(e.redrawn for e in outcome),
        "per_episode": [e.plain() for e in outcome],
        "seed": seed,
        **task_facts(config, seed),
        "wall_seconds": round(wall, 2),
        "wall_seconds_with_references": round(time.perf_counter() - begin, 2),
        "fingerprints": facts.fingerprints,
        "commit": source_commit(),
        "trained_at": facts.trained_at,
        "hardware": hardware(),
    }


def task_facts(config: ExperimentConfig, seed: int) -> dict[str, Any]:
    """What besides weights decides a result, as JSON stores it: task, renderer, first evaluation seed."""
    values = {"env": to_dict(config.acting), "render": to_dict(config.render), "first_seed": first_seed(config, seed)}
    return json.loads(json.dumps(values))  # type: ignore[no-any-return]


def evaluate_run(
    run: Path, agent: Agent, config: ExperimentConfig, protocol: str, pool: TaskPool | None = None
) -> dict[str, Any]:
    """Evaluate a run's agent with the config's `episodes` and `seed`; write `RUN/evaluation/PROTOCOL/eval_info.json`. A
    CheckpointError where the run has no trained policy.
    """
    episodes = config.episodes or DEFAULT_EPISODES
    result = evaluate(agent, config, protocol, episodes, config.seed, facts=run_facts(run), run=run, pool=pool)
    return _stored(run, result)


def evaluate_actor(run: Path, actor: Actor, config: ExperimentConfig, pool: TaskPool | None = None) -> dict[str, Any]:
    """Evaluate a baseline's actor in closed loop, as `evaluate_run` does an agent; the same file, the same keys. A
    ConfigError for protocol `imagination` or `replay`, a CheckpointError where the run has no trained policy of
    `config.method`.
    """
    check_baseline_protocol(config)
    facts, episodes = run_facts(run, config.method), config.episodes or DEFAULT_EPISODES
    return _stored(run, measure(actor, config, "simulation", episodes, config.seed, facts=facts, run=run, pool=pool))


def check_baseline_protocol(config: ExperimentConfig) -> None:
    """Refuse another protocol than simulation, by a ConfigError."""
    if config.protocol != "simulation":
        raise ConfigError(
            f"protocol: got {config.protocol} for method={config.method}, expected simulation: "
            "only PlaySlot has latent actions of a world model"
        )


def _stored(run: Path, result: dict[str, Any]) -> dict[str, Any]:
    write_json(run / "evaluation" / str(result["protocol"]) / "eval_info.json", result)
    return result


def hardware() -> dict[str, Any]:
    """Where and on what a result was measured."""
    return {
        "machine": platform.machine(),
        "processor": processor(),
        "system": platform.system(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def summary(episodes: Sequence[Outcome], env: EnvConfig | None = None) -> dict[str, Any]:
    """`success_rate` (0 to 1), `ci95` (Wilson) and `mean_steps_to_success` (agent steps; None without a success); where
    no success is measured these are None, and there are `mean_return`, of agent steps' rewards, and its standard error.
    Of several tasks in one `env`, `per_task` holds the same of each, and its number of `episodes`.
    """
    if env is not None and env.tasks:
        split = {name: [e for e in episodes if env.of_episode(e.seed).task == name] for name in env.tasks}
        of_each = {name: {"episodes": len(some), **summary(some)} for name, some in split.items() if some}
        return {**summary(episodes), "per_task": of_each}
    if any(e.success is None for e in episodes):
        totals = np.array([e.total for e in episodes], np.float64)
        error = float(totals.std(ddof=1) / math.sqrt(len(totals))) if len(totals) > 1 else None
        return {**NOTHING, "mean_return": float(totals.mean()), "return_error": error}
    steps = [e.steps for e in episodes if e.steps is not None]
    return {
        "success_rate": len(steps) / len(episodes),
        "ci95": list(wilson(len(steps), len(episodes))),
        "mean_steps_to_success": float(np.mean(steps)) if steps else None,
    }


def run_references(
    oracle: Actor | None,
    config: ExperimentConfig,
    seeds: Sequence[int],
    pool: TaskPool,
    oracle_fingerprint: str = "",
    cache: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """Results of `random`, `expert` and `slot_oracle`, always closed-loop; null values without an oracle.

    `cache` is a JSON file that both protocols of a run share. The oracle's result is in it by the weights of oracle and
    SAVi that `oracle_fingerprint` names; empty, it is not cached.
    """
    actors: dict[str, Actor] = {"random": RandomActor(config.acting.max_steps, config.acting.action_dim)}
    results: dict[str, dict[str, Any]] = {}
    if getattr(pool.take(1)[0], "has_expert", True):
        actors["expert"] = ExpertActor()
    else:
        results["expert"] = dict(NOTHING)
    if oracle is not None:
        actors["slot_oracle"] = oracle
    stored: dict[str, dict[str, Any]] = {}
    if cache is not None and cache.is_file():
        with contextlib.suppress(json.JSONDecodeError):  # only a cache: run the references again
            stored = json.loads(cache.read_text())
    for name, actor in actors.items():
        weights = oracle_fingerprint if name == "slot_oracle" else name
        what = [weights, to_dict(config.acting), to_dict(config.render), list(seeds)]
        key = f"{name}-{hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]}"
        if not weights or key not in stored:
            stored[key] = summary(run_episodes(pool, actor, seeds), config.acting)
        results[name] = stored[key]
    if oracle is None:
        results["slot_oracle"] = dict(NOTHING)
    if cache is not None:
        kept = {k: v for k, v in stored.items() if oracle_fingerprint or not k.startswith("slot_oracle")}
        write_json(cache, kept)
    return results
