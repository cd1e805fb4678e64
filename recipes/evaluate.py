"""`playslot evaluate run=DIR protocol=simulation|imagination|replay|slots episodes=N seed=S`: success of a policy.

Writes `DIR/evaluation/PROTOCOL/eval_info.json` and, after success of a PlaySlot run, `DIR/report.md` and `.html` anew.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import EnvConfig, ExperimentConfig, plugins
from playslot_rl.config.methods import METHODS, method_stage
from playslot_rl.envs import PROCEDURAL, RECORDED, check_task
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.recipes import objects
from playslot_rl.runs import Run
from playslot_rl.runs.opening import require_task, run_of_pretrained, run_to_read
from playslot_rl.runtime.devices import open_device


def main(config: ExperimentConfig, report: bool = True) -> None:
    """Evaluate the policy of `config.run` under `config.protocol` and print the result.

    A pretrained policy (`run=pretrained/ENV`) is copied into `out`, which becomes a run like any other. A baseline's
    run (`method` in its config) is evaluated in simulation only. Where there is no simulator (GridShapes) its slots and
    latent actions are scored instead: see `recipes.objects`. With `report` PlaySlot's is renewed after its success.
    """
    run = run_with_policy(config)
    if run.pretrained:
        run = run_of_pretrained(config, run)
        config = replace(config, run=str(run.folder), out="")
    if config.protocol == "actions":
        error_of_actions(config, run)
        return
    if config.env.name in RECORDED:
        raise ConfigError(
            f"protocol: got {config.protocol} with env={config.env.name}, which has no simulator, expected actions: "
            "the error on demonstrations that nothing was trained on"
        )
    own = METHODS[config.method].imagines
    if own and config.env.name in PROCEDURAL:
        objects.main(config, run)
    elif own and config.protocol == "slots":
        objects.score_slots(config, run)
    else:
        _success(config, run, report and own)


def _success(config: ExperimentConfig, run: Run, report: bool) -> None:
    """Measure a policy's success, a baseline's in simulation only, write `evaluation/PROTOCOL/eval_info.json`, and
    print the result."""
    from playslot_rl.acting.episodes import TaskPool
    from playslot_rl.evaluation.success import check_baseline_protocol, evaluate_actor, evaluate_run

    own = METHODS[config.method].imagines
    if not own:
        check_baseline_protocol(config)
    trained = _require_policy(config, run)
    check_task(config.env)
    if config.env.seen != trained.seen:
        print(f"note: evaluated with {config.env.seen}; run={config.run} was trained with {trained.seen}", flush=True)
    device = open_device(config.device, config.threads)
    agent = run.load_agent(device) if own else None
    with TaskPool(config.acting, config.render) as pool:
        if agent is not None:
            result = evaluate_run(run.folder, agent, config, config.protocol, pool)
        else:
            actor = plugins.call(METHODS[config.method].load.actor, run, device).eval()
            result = evaluate_actor(run.folder, actor, config, pool)
        print(describe(result, run.folder), flush=True)
        if report:
            from playslot_rl.visualization.report import write_report

            print(f"report: {write_report(run.folder, agent=agent, pool=pool)}")


def _require_policy(config: ExperimentConfig, run: Run) -> EnvConfig:
    """What a run's policy was trained in; refuses one without, or of another task, before anything is loaded."""
    from playslot_rl.evaluation.success import run_facts

    run_facts(run.folder, config.method)
    trained = run.own(method_stage(config.method)).group(EnvConfig, "env")
    require_task(config, trained)
    return trained


def error_of_actions(config: ExperimentConfig, run: Run) -> None:
    """Hold the policy's actions against held-out demonstrations, and print the result."""
    from playslot_rl.evaluation.actions import evaluate_actions, require_offline

    require_offline(config.method)
    _require_policy(config, run)
    result = evaluate_actions(run, config, open_device(config.device, config.threads))
    print(describe_actions(result, run.folder), flush=True)


def main_if_needed(config: ExperimentConfig) -> None:
    """Evaluate under both protocols and renew the report, leaving out what this policy was measured on before."""
    from playslot_rl.evaluation.success import POLICY_PROTOCOLS, run_facts

    run = run_with_policy(config)
    if config.env.name in PROCEDURAL:
        objects.main_if_needed(config, run)
        return
    run_facts(run.folder)  # a run without a policy is refused before anything is loaded
    due = [protocol for protocol in POLICY_PROTOCOLS if once(replace(config, protocol=protocol))]
    if due or not renewed(run):
        from playslot_rl.visualization.report import write_report

        agent = run.load_agent(open_device(config.device, config.threads))
        print(f"report: {write_report(run.folder, agent=agent)}", flush=True)


def renewed(run: Run) -> bool:
    """Whether the run has a report that is not older than its report card."""
    from playslot_rl.evaluation.card import RESULT

    report, card = run.folder / "report.html", run.folder / RESULT
    return report.is_file() and not (card.is_file() and card.stat().st_mtime_ns > report.stat().st_mtime_ns)


def once(config: ExperimentConfig) -> bool:
    """Evaluate under `config.protocol`, without a report, unless the same policy was measured so before; whether it was
    measured now.
    """
    from playslot_rl.evaluation.actions import error_text
    from playslot_rl.evaluation.before import measured_before

    stored = measured_before(config)
    if stored is None:
        main(config, report=False)
        return True
    said = f"error {error_text(stored)}" if config.protocol == "actions" else rate(stored)
    print(f"{config.protocol}: measured before, {said}, skipped", flush=True)
    return False


def run_with_policy(config: ExperimentConfig, command: str = "evaluate") -> Run:
    """The run of a command that needs a policy (`run_to_read`), which is no pretrained world model without one."""
    run = run_to_read(config, command, "the folder of a run with a trained policy, such as run=runs/demo")
    if run.pretrained and config.protocol != "slots" and not run.has("policy"):
        raise CheckpointError(f"run={config.run} is a world model without a policy; run `playslot train-policy`")
    if (got := config.data.stride) != (expected := run.view.stride):
        raise ConfigError(f"data.stride: got {got}, expected {expected}, as run={config.run} was trained: leave it out")
    return run


def rate(row: dict[str, Any]) -> str:
    """Success, or the return where none is measured."""
    if row["success_rate"] is None:
        return f"return {row['mean_return']:.2f}"
    return f"{100 * row['success_rate']:.0f} % success"


def describe(result: dict[str, Any], run: Path) -> str:
    """The result in a few lines."""
    title = METHODS[result["method"]].title
    rows = [(f"{title}, {result['protocol']}", result)]
    rows += list(result.get("per_task", {}).items())
    rows += [(name.replace("_", " "), reference) for name, reference in result["references"].items()]
    lines = []
    for name, row in rows:
        if row["success_rate"] is None:
            lines += [f"{name:>22}: {rate(row)}"] if "mean_return" in row else []
            continue
        low, high = row["ci95"]
        steps = row.get("mean_steps_to_success")
        mean = "" if steps is None else f", {steps:.1f} agent steps on average"
        lines.append(f"{name:>22}: {100 * row['success_rate']:3.0f} % ({100 * low:.0f} to {100 * high:.0f} %){mean}")
    path = run / "evaluation" / result["protocol"] / "eval_info.json"
    took = result["wall_seconds_with_references"]
    return "\n".join([*lines, f"{result['episodes']} episodes each, {took:.0f} s; written to {path}"])


def describe_actions(result: dict[str, Any], run: Path) -> str:
    """The error of actions in a few lines: the policy, what to hold it against, and each dimension."""
    from playslot_rl.evaluation.actions import error_text

    references = result["references"]
    rows = [(METHODS[result["method"]].title, result)]
    rows += [("constant mean action", references["constant"]), ("previous action again", references["previous"])]
    lines = [f"{name:>22}: error {error_text(row)}" for name, row in rows]
    for row in result["per_dimension"]:
        lines.append(f"{row['name']:>22}: error {row['mae']:.3g}, of the constant {row['constant_mae']:.3g}")
    if result["untold"]:
        lines.append(f"note: {', '.join(result['untold'])}: of an earlier version, does not say what it was trained on")
    path = run / "evaluation" / "actions" / "eval_info.json"
    counted = f"{result['episodes']} held-out episodes, {result['rows']:,} actions of {result['data']['name']}"
    return "\n".join([*lines, f"{counted}, {result['wall_seconds']:.0f} s; written to {path}"])
