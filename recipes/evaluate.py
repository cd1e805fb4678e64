"""`playslot evaluate run=DIR protocol=simulation|imagination|replay|slots episodes=N seed=S`: success of a policy.

Writes `DIR/evaluation/PROTOCOL/eval_info.json` and renews `DIR/report.md` and `DIR/report.html`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from playslot_rl.config import EnvConfig, ExperimentConfig
from playslot_rl.config.compose import shipped
from playslot_rl.config.methods import METHODS, method_stage
from playslot_rl.envs import PROCEDURAL
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.recipes import objects, slots
from playslot_rl.recipes.run import existing_run, open_run, parent_run, stored_result

SAME_TASK: Final = ("name", "image_size", "action_dim")
"""Of an environment: what it shares with the one a policy was trained for."""


def main(config: ExperimentConfig, report: bool = True) -> None:
    """Evaluate the policy of `config.run` under `config.protocol` and print the result.

    A shipped policy (`run=pretrained/ENV`) is copied into `out`, which becomes a run like any other. A baseline's run
    (`method` in its config) is evaluated in simulation only. Where there is no
    simulator (GridShapes) its slots and latent actions are scored instead: see `recipes.objects`.

    Args:
        config: `run`, `protocol`, `episodes` (50 if None), `seed`, `device`, `env`, `render`, `evaluation`.
        report: renew the run's report afterwards.

    Raises:
        ConfigError: no run was named, or `out` names another folder.
        CheckpointError: the run does not exist, has no trained policy, or was made for another frame size.
        OutputError: the result cannot be written.
    """
    run = check_run(config)
    if shipped(config.run):
        run = take_shipped(config)
        config = replace(config, run=str(run), out="")
    if config.method != "playslot":
        evaluate_baseline(config, run)
        return
    if config.env.name in PROCEDURAL:
        objects.main(config, run)
        return
    if config.protocol == "slots":
        slots.main(config, run)
        return
    from playslot_rl.acting.episodes import TaskPool
    from playslot_rl.evaluation.success import check_protocol, evaluate_run, run_facts
    from playslot_rl.recipes.run import open_device
    from playslot_rl.training.runs import load_agent

    check_protocol(config.protocol)
    run_facts(run)  # a run without a policy is refused before anything is loaded
    check_environment(config, trained_environment(run, "policy"))
    agent = load_agent(run, open_device(config))
    with TaskPool(config.env, config.render) as pool:
        result = evaluate_run(run, agent, config, config.protocol, pool)
        print(describe(result, run))
        if report:
            from playslot_rl.visualization.report import write_report

            print(f"report: {write_report(run, agent=agent, pool=pool)}")


def evaluate_baseline(config: ExperimentConfig, run: Path) -> None:
    """Evaluate the baseline of `run` in simulation, write `RUN/evaluation/simulation/eval_info.json`, print the result.

    Raises:
        ConfigError: protocol `imagination`, or an environment other than the run's.
        CheckpointError: the run has no trained policy, or a damaged one.
    """
    from playslot_rl.acting.episodes import TaskPool
    from playslot_rl.evaluation.success import check_baseline_protocol, evaluate_actor, run_facts
    from playslot_rl.recipes.run import open_device

    check_baseline_protocol(config)
    run_facts(run, config.method)  # a run without a policy is refused before anything is loaded
    check_environment(config, trained_environment(run, method_stage(config.method)))
    device = open_device(config)
    module, _, function = METHODS[config.method].actor.partition(":")
    actor = getattr(importlib.import_module(module), function)(run, device)
    actor.eval()
    with TaskPool(config.env, config.render) as pool:
        print(describe(evaluate_actor(run, actor, config, pool), run), flush=True)


def main_if_needed(config: ExperimentConfig) -> None:
    """Evaluate under both protocols and renew the report, leaving out what this policy was measured on before."""
    from playslot_rl.evaluation.success import DEFAULT_EPISODES, POLICY_PROTOCOLS, run_facts, task_facts

    run = check_run(config)
    if config.env.name in PROCEDURAL:
        objects.main_if_needed(config, run)
        return
    facts = {
        "episodes": config.episodes or DEFAULT_EPISODES,
        "seed": config.seed,
        "fingerprints": run_facts(run).fingerprints,
        **task_facts(config, config.seed),
    }
    due = [protocol for protocol in POLICY_PROTOCOLS if not measured(run, protocol, facts)]
    for protocol in due:
        main(replace(config, protocol=protocol), report=False)
    if due or not renewed(run):
        from playslot_rl.recipes.run import open_device
        from playslot_rl.training.runs import load_agent
        from playslot_rl.visualization.report import write_report

        print(f"report: {write_report(run, agent=load_agent(run, open_device(config)))}", flush=True)


def renewed(run: Path) -> bool:
    """Whether the run has a report that is not older than its report card."""
    from playslot_rl.evaluation.card import RESULT

    report, card = run / "report.html", run / RESULT
    return report.is_file() and not (card.is_file() and card.stat().st_mtime_ns > report.stat().st_mtime_ns)


def measured(run: Path, protocol: str, facts: dict[str, Any]) -> bool:
    """Whether the run was measured under a protocol with the same `facts` (parts of its result); if so, say it."""
    stored = stored_result(run / "evaluation" / protocol / "eval_info.json", facts)
    if stored is None:
        return False
    print(f"{protocol}: measured before, {100 * stored['success_rate']:.0f} % success, skipped", flush=True)
    return True


def check_run(config: ExperimentConfig, command: str = "evaluate") -> Path:
    """The run folder of a command that needs a policy.

    Raises:
        ConfigError: none was named, or `out` names another folder.
        CheckpointError: there is no such folder, or it is a shipped world model without a policy.
    """
    if not config.run:
        raise ConfigError("run: got nothing, expected the folder of a run with a trained policy, such as run=runs/demo")
    if shipped(config.run):
        from playslot_rl.storage.checkpoints import checkpoint_folder
        from playslot_rl.training.runs import run_folder

        folder = run_folder(parent_run(config, Path()))
        if config.protocol != "slots" and not (checkpoint_folder(folder, "policy") / "meta.json").is_file():
            raise CheckpointError(f"run={config.run} is a world model without a policy; run `playslot train-policy`")
        return folder
    return existing_run(config, command, "make one by `playslot demo`")


def take_shipped(config: ExperimentConfig) -> Path:
    """Make `out` a run of the shipped model: the name of its world model, its policy if it has one, and this config.

    Raises:
        ConfigError: no `out`.
        CheckpointError: `out` has another policy.
        OutputError: the folder cannot be written.
    """
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.training.runs import adopt_stage, require_adoptable, run_folder, store_config, use_world_model

    if not config.out:
        raise ConfigError(f"out: got nothing with run={config.run}, expected a folder to write, such as out=runs/check")
    run = open_run(config)
    parent = parent_run(config, run)
    folder = checkpoint_folder(run_folder(parent), "policy")
    policy = read_stage(folder, "policy") if (folder / "meta.json").is_file() else None
    if policy is not None:
        check_environment(config, trained_environment(run_folder(parent), "policy"))
        require_adoptable(policy, run)
    store_config(replace(config, run="", out=""), run)
    use_world_model(run, parent)
    if policy is not None:
        adopt_stage(policy, run)
    return run


def trained_environment(run: Path, stage: str) -> EnvConfig:
    """The environment that a stage of a run was trained for.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.training.runs import stage_config

    return stage_config(read_stage(checkpoint_folder(run, stage), stage), EnvConfig, "env")


def check_environment(config: ExperimentConfig, trained: EnvConfig, names: Sequence[str] = SAME_TASK) -> None:
    """Refuse an environment that is not the one the run was trained on: of another task, frame size or action size.

    Args:
        config: of the command.
        trained: the environment that a checkpoint of the run names.
        names: of the settings that have to agree.

    Raises:
        ConfigError: they differ.
    """
    for name in names:
        got, expected = getattr(config.env, name), getattr(trained, name)
        if got != expected:
            key = "env" if name == "name" else f"env.{name}"
            raise ConfigError(
                f"{key}: got {got}, expected {expected}, with which run={config.run} was trained: leave {key}= out"
            )


def describe(result: dict[str, Any], run: Path) -> str:
    """The result in a few lines."""
    title = METHODS[result["method"]].title
    rows = [(f"{title}, {result['protocol']}", result)]
    rows += [(name.replace("_", " "), reference) for name, reference in result["references"].items()]
    lines = []
    for name, row in rows:
        if row["success_rate"] is None:
            continue
        low, high = row["ci95"]
        steps = row.get("mean_steps_to_success")
        mean = "" if steps is None else f", {steps:.1f} agent steps on average"
        lines.append(f"{name:>22}: {100 * row['success_rate']:3.0f} % ({100 * low:.0f} to {100 * high:.0f} %){mean}")
    path = run / "evaluation" / result["protocol"] / "eval_info.json"
    took = result["wall_seconds_with_references"]
    return "\n".join([*lines, f"{result['episodes']} episodes each, {took:.0f} s; written to {path}"])
