"""`playslot plan run=DIR planner=NAME proposal=none|policy episodes=N seed=S`: goal images reached by planning.

Writes `RUN/planning/GOALS/METHOD/eval_info.json`, `plan.png` beside it, `GOALS/cost.png`, and the table
`RUN/planning/planning.md` and `.json` (docs/how-to/plan.md).
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.methods import METHODS
from playslot_rl.config.planning import GoalName
from playslot_rl.envs import check_task
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.recipes.evaluate import run_with_policy
from playslot_rl.runs.opening import require_one_task, require_task, run_of_pretrained
from playslot_rl.runtime.devices import open_device

if TYPE_CHECKING:
    from playslot_rl.evaluation.goals import GoalEpisode, GoalPool
    from playslot_rl.world_model import Agent

EPISODES = 20


def main(config: ExperimentConfig) -> None:
    """Plan towards both kinds of goals, beside random actions and the latent policy, and print the table."""
    from playslot_rl.acting.planners import search_size

    run = run_with_policy(config, "plan")
    require_one_task(config, "plan")
    check_task(config.env, expert=True, success=True)  # refuses what has no simulator
    frame_skip = config.acting.frame_skip
    try:
        sizes = {goals: search_size(config.plan, goals, frame_skip) for goals in config.plan.goals}
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if not METHODS[config.method].imagines:
        raise CheckpointError(f"run={config.run}: got a run of method={config.method}, expected one of playslot's own")
    if run.pretrained:
        run = run_of_pretrained(config, run)
    from playslot_rl.evaluation.goals import GoalPool
    from playslot_rl.evaluation.success import run_facts
    from playslot_rl.storage.atomic import write_json, write_text
    from playslot_rl.storage.checkpoints import source_commit
    from playslot_rl.visualization.document import to_markdown
    from playslot_rl.visualization.planning_page import planning_page

    facts = run_facts(run.folder)
    agent = run.load_agent(open_device(config.device, config.threads))
    require_task(config, agent.world_model.env)
    mode = agent.world_model.config.inverse_dynamics.mode
    if mode in ("ground_truth", "none"):
        raise CheckpointError(
            f"run={config.run}: got a world model of mode {mode}, expected one that infers latents, which costs "
            "compare: train one with model.inverse_dynamics.mode=hybrid"
        )
    folder, parts = run.folder / "planning", {}
    for goals, size in sizes.items():
        with GoalPool(config.acting, config.render) as pool:
            common = {"demos": facts.demos, "labelled_demos": facts.labelled_demos, **_facts(config, run.folder)}
            common |= {"fingerprints": facts.fingerprints, "commit": source_commit(), "trained_at": facts.trained_at}
            common |= {"size": asdict(size)}
            parts[goals] = _measure(config, agent, pool, goals, folder / goals, common)
    report = {"run": config.run, "command": shlex.join(["playslot", *sys.argv[1:]]), "settings": to_dict(config.plan)}
    report |= {"goals": parts, **_facts(config, run.folder)}
    write_json(folder / "planning.json", report)
    page = to_markdown(planning_page(report))
    write_text(folder / "planning.md", page)
    print(f"{page}\nwritten to {folder / 'planning.md'}", flush=True)


def _facts(config: ExperimentConfig, run: Path) -> dict[str, Any]:
    """What every result of this command says alike."""
    from playslot_rl.evaluation.success import hardware, task_facts

    return {"seed": config.seed, **task_facts(config, config.seed), "hardware": hardware(), "folder": str(run)}


def _measure(
    config: ExperimentConfig, agent: Agent, pool: GoalPool, goals: GoalName, folder: Path, common: dict[str, Any]
) -> dict[str, Any]:
    """All ways of acting towards one kind of goal: a part of the report."""
    from playslot_rl.evaluation.goals import make_goals
    from playslot_rl.evaluation.held_out import check_disjoint, first_seed, training_seeds
    from playslot_rl.evaluation.planning import cost_along_solution, play, results, steps_to_act, ways_of_acting
    from playslot_rl.storage.atomic import write_bytes, write_json
    from playslot_rl.visualization.charts import LIGHT
    from playslot_rl.visualization.planning_page import solution_chart

    plan, first = config.plan, first_seed(config, config.seed)
    episodes = make_goals(pool, range(first, first + (config.episodes or EPISODES)), goals, plan, config.seed)
    check_disjoint([episode.seed for episode in episodes], training_seeds(config, Path(common["folder"])))
    solution = cost_along_solution(agent, episodes, plan.looks, plan.match)
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / "cost.png", solution_chart(solution, LIGHT))
    steps = steps_to_act(config, goals)
    every, found = common["size"]["every"], {}
    for name, actor in ways_of_acting(config, agent, goals, episodes).items():
        played = play(pool, actor, episodes, goals, steps, every, draw=False)
        found[name] = {
            "method": name,
            "protocol": f"planning, goals {goals}",
            "episodes": len(episodes),
            "seeds": [episode.seed for episode in episodes],
            "max_steps": steps,
            "planning": to_dict(plan),
            **results(played, episodes, plan.near),
            **common,
        }
        print(f"{goals}: {name}: {100 * found[name]['success_rate']:.0f} %, {played.wall:.0f} s", flush=True)
        (folder / name).mkdir(exist_ok=True)
        write_json(folder / name / "eval_info.json", found[name])
        if played.plans and plan.pictures:
            _draw(agent, episodes[: plan.pictures], played, folder / name)
    part = {"episodes": len(episodes), "max_steps": steps, "size": common["size"], "rows": found}
    return {**part, "cost_along_solution": solution}


def _draw(agent: Agent, episodes: list[GoalEpisode], played: Any, folder: Path) -> None:
    """The first plans, and what came of them."""
    import numpy as np

    from playslot_rl.evaluation.planning import decoded_plan
    from playslot_rl.frames import png
    from playslot_rl.storage.atomic import write_bytes
    from playslot_rl.visualization.planning_page import plan_sheet

    plans = [decoded_plan(agent, slots) for slots in played.plans[: len(episodes)]]
    executed = [np.stack(trace.frames) for trace in played.traces[: len(episodes)]]
    write_bytes(folder / "plan.png", png(plan_sheet([e.frames for e in episodes], plans, executed)))
