"""Comparisons of several tasks by one command: each in a folder of its own, and a table over all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError, OutputError, PlaySlotError, explain
from playslot_rl.evaluation.success import DEFAULT_EPISODES
from playslot_rl.storage.atomic import read_json
from playslot_rl.studies import launch
from playslot_rl.studies.study import Result, check_study, compute_study, origin, tables, write_result
from playslot_rl.studies.success.figure import tasks_figure
from playslot_rl.studies.success.measure import SuccessMeasure, task_results
from playslot_rl.studies.success.task_table import joint_table, tasks_page


def compare_tasks(configs: Sequence[ExperimentConfig], out: Path) -> None:
    """Compare each task in `OUT/TASK`, one after the other, and write `OUT/comparison.json`, `.md`, `.png` and `.svg`.

    Raises:
        ConfigError, DataError, CheckpointError, OutputError: one of them cannot be compared; before anything is
            computed.
        PlaySlotError: a task failed, or a job of it; the others have finished, and the page says so.
    """
    measures = _measures(configs, out)
    others = task_results(configs[0], list(measures))
    for measure in measures.values():
        check_study(measure)
    launch.open_comparison(out)
    if (out / "jobs").is_dir():
        raise OutputError(f"out={out}: got the comparison of one task, expected none, or one of envs=: choose another")
    results, errors = dict[str, Result](), dict[str, str]()
    with launch.comparison_lock(out):
        for number, (task, measure) in enumerate(measures.items(), 1):
            print(f"compare: {task}, task {number} of {len(measures)}", flush=True)
            try:
                failed = compute_study(measure)
                results[task] = read_json(out / task / "comparison.json", "type the command again")
            except PlaySlotError as error:
                failed = explain(error)
            errors |= {task: failed} if failed else {}
            result = _joint(configs[0], results, others, errors)
            page = tasks_page(result)
            write_result(out / "comparison", result, page, lambda _, theme: tasks_figure(results, theme))
    print(f"{tables(page)}\ncompare: {out / 'comparison.md'}", flush=True)
    if errors:
        raise PlaySlotError(
            f"compare: {len(errors)} of {len(measures)} tasks failed ({', '.join(errors)}), the others finished; "
            f"{out / 'comparison.md'} says why, and the same command tries them again"
        )


def _measures(configs: Sequence[ExperimentConfig], out: Path) -> dict[str, SuccessMeasure]:
    """By the names of the tasks, which are those of their folders; a ConfigError where two are the same."""
    found, typed = {}, configs[0].compare.envs
    for config in configs:
        task = config.env.full_name
        own = replace(config, out=str(out / task), compare=replace(config.compare, tasks=""))
        found[task] = SuccessMeasure(own)
    if len(found) != len(typed):
        raise ConfigError(f"envs: got {', '.join(typed)}, which are {', '.join(found)}, expected each task once")
    return found


def _joint(
    config: ExperimentConfig, results: Mapping[str, Result], others: Sequence[Result], errors: Mapping[str, str]
) -> dict[str, Any]:
    """What `OUT/comparison.json` holds, of the tasks that have had their turn and those of `compare.tasks`."""
    own, every = config.compare, [*results.values(), *others]
    reference = own.reference if own.reference in own.methods else None
    return {
        "preset": config.preset,
        "methods": list(own.methods),
        "demos": list(own.demos),
        "labels": list(own.labels),
        "videos": list(own.videos),
        "seeds": list(own.seeds),
        "episodes": config.episodes or DEFAULT_EPISODES,
        "blocks": [result["block"] for result in every],
        "across_tasks": joint_table(every, reference),
        "errors": dict(errors),
        "seconds": sum(result["seconds"] for result in results.values()),
        **origin(),
    }
