"""The table of `playslot plan`: one row a way of acting and kind of goal, as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

TITLES: Mapping[str, str] = {"random": "random actions", "policy": "latent policy", "expert": "scripted expert"}
GOALS: Mapping[str, str] = {
    "solved": "the frame in which the expert solves the task",
    "ahead": "the expert's frame {ahead} environment steps ahead, budget {budget} (stable-worldmodel's protocol)",
}


def title(name: str) -> str:
    """What a row is called: `cem-policy` is "CEM from the policy"."""
    planner, _, proposal = name.partition("-")
    words = {"cem": "CEM", "mppi": "MPPI", "gradient": "gradient", "prototypes": "prototypes"}.get(planner)
    if words is None:
        return TITLES.get(name, name)
    return f"{words} from the policy" if proposal else f"{words} alone"


def table(report: Mapping[str, Any]) -> str:
    """The page `planning.md`.

    Args:
        report: what `planning.json` holds: `run`, `command`, `settings`, and under `goals` for each kind of goal
            `rows` (a result of each way of acting by name), `cost_along_solution`, `size` and `episodes`.
    """
    lines = [f"# Planning: {report['run']}", "", f"`{report['command']}`", ""]
    for name, part in report["goals"].items():
        goal = GOALS[name].format(**report["settings"])
        size = ", ".join(f"{key} {value}" for key, value in part["size"].items())
        lines += [
            f"## Goals: {goal}",
            "",
            f"{part['episodes']} episodes of {part['max_steps']} agent steps. {size}.",
            "",
        ]
        lines += [*rows(part["rows"]), "", *_solution(part["cost_along_solution"]), ""]
    return "\n".join(lines)


def rows(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The lines of one table."""
    lines = [
        "| | success | by state | off its place at the end, m | planned cost, of the proposal | s a decision |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in results.items():
        cost = "" if row["plan_cost_first"] is None else f"{row['plan_cost_first']:.4f}"
        if row["proposal_cost_first"] is not None:
            cost += f", {row['proposal_cost_first']:.4f}"
        seconds = "" if row["seconds_per_decision"] is None else f"{row['seconds_per_decision']:.2f}"
        lines.append(
            f"| {title(name)} | {_rate(row['success_rate'], row['ci95'])} | "
            f"{_rate(row['state_success_rate'], row['state_ci95'])} | "
            f"{row['state_distance']:.3f} (start {row['state_distance_at_start']:.3f}) | {cost} | {seconds} |"
        )
    return lines


def _rate(rate: float, interval: Sequence[float]) -> str:
    return f"{100 * rate:.0f} % ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"


def _solution(found: Mapping[str, Any]) -> list[str]:
    lines = [
        "Cost along the expert's own way (`cost.png`):",
        "",
        "| distance | goal is the minimum | steps that lower it | highest over start |",
        "|---|---|---|---|",
    ]
    for name in ("slots", "dynamics", "image"):
        one = found[name]
        lines.append(
            f"| {name} | {100 * one['goal_is_minimum']:.0f} % | {100 * one['downhill']:.0f} % | {one['hill']:.2f} |"
        )
    error, moved = found["model_error"], found["moved"]
    said = f"Slot error at the goal, imagined under the inferred latents: {error:.4f}; standing still: {moved:.4f}."
    return [*lines, "", said]
