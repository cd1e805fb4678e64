"""The page of `playslot plan`, and its pictures: start, goal, first plan and what was executed; the cost along
solutions.

Shapes: T steps, H horizon, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from playslot_rl.evaluation.goals import Frames
from playslot_rl.evaluation.intervals import rate_text
from playslot_rl.visualization.charts import Theme, figure_bytes, legend, panel_grid, style_axes
from playslot_rl.visualization.document import Document, Section, Table, Text
from playslot_rl.visualization.grid import image_grid

COLUMNS = 8
TITLES: Mapping[str, str] = {"random": "random actions", "policy": "latent policy", "expert": "scripted expert"}
PLANNERS: Mapping[str, str] = {"cem": "CEM", "mppi": "MPPI", "gradient": "gradient", "prototypes": "prototypes"}
GOALS: Mapping[str, str] = {
    "solved": "the frame in which the expert solves the task",
    "ahead": "the expert's frame {ahead} environment steps ahead, budget {budget} (stable-worldmodel's protocol)",
}
DISTANCES = ("slots", "dynamics", "image")


def planning_page(report: Mapping[str, Any]) -> Document:
    sections = []
    for name, part in report["goals"].items():
        size = ", ".join(f"{key} {value}" for key, value in part["size"].items())
        said = f"{part['episodes']} episodes of {part['max_steps']} agent steps. {size}."
        goal = GOALS[name].format(**report["settings"])
        blocks = [Text(said), _ways_table(part["rows"]), *_solution(part["cost_along_solution"])]
        sections.append(Section(f"Goals: {goal}", blocks))
    return Document(f"Planning: {report['run']}", f"`{report['command']}`", sections)


def title(name: str) -> str:
    """What a row is called: `cem-policy` is "CEM from the policy"."""
    planner, _, proposal = name.partition("-")
    if planner not in PLANNERS:
        return TITLES.get(name, name)
    return f"{PLANNERS[planner]} from the policy" if proposal else f"{PLANNERS[planner]} alone"


def _ways_table(results: Mapping[str, Mapping[str, Any]]) -> Table:
    body = []
    for name, row in results.items():
        cost = "" if row["plan_cost_first"] is None else f"{row['plan_cost_first']:.4f}"
        if row["proposal_cost_first"] is not None:
            cost += f", {row['proposal_cost_first']:.4f}"
        rates = [rate_text(row[f"{by}success_rate"], row[f"{by}ci95"]) for by in ("", "state_")]
        away = f"{row['state_distance']:.3f} (start {row['state_distance_at_start']:.3f})"
        seconds = "" if row["seconds_per_decision"] is None else f"{row['seconds_per_decision']:.2f}"
        body.append([title(name), *rates, away, cost, seconds])
    headers = ["success", "by state", "off its place at the end, m", "planned cost, of the proposal", "s a decision"]
    return Table(["", *headers], body)


def _solution(found: Mapping[str, Any]) -> list[Text | Table]:
    body = []
    for name in DISTANCES:
        one = found[name]
        shares = [f"{100 * one[key]:.0f} %" for key in ("goal_is_minimum", "downhill")]
        body.append([name, *shares, f"{one['hill']:.2f}"])
    error, moved = found["model_error"], found["moved"]
    return [
        Text("Cost along the expert's own way (`cost.png`):"),
        Table(["distance", "goal is the minimum", "steps that lower it", "highest over start"], body),
        Text(f"Slot error at the goal, imagined under the inferred latents: {error:.4f}; standing still: {moved:.4f}."),
    ]


def plan_sheet(goals: Sequence[Frames], plans: Sequence[Frames], executed: Sequence[Frames]) -> Image.Image:
    """Two rows an episode: start and goal, then the first plan as it was imagined over what was executed. `goals` are
    the expert's ways (T + 1, H, W, 3), plans (H + 1, H, W, 3), executed frames (T' + 1, H, W, 3); where an episode
    ended before the horizon its last one is repeated.
    """
    cells, rows = [], []
    shown = np.unique(np.linspace(1, len(plans[0]) - 1, COLUMNS).round().astype(int))
    for number, (goal, plan, done) in enumerate(zip(goals, plans, executed, strict=True), 1):
        ends = [goal[0], goal[-1]]
        cells.append(np.stack([*ends, *plan[shown]]))
        cells.append(np.stack([*ends, *done[shown.clip(max=len(done) - 1)]]))
        rows += [f"{number} imagined", "executed"]
    return image_grid(np.stack(cells), rows, ["start", "goal", *(f"t = {t}" for t in shown)])


def solution_chart(found: Mapping[str, Any], theme: Theme) -> bytes:
    """PNG of each distance to the goal along the expert's way, in units of its value at the start: a panel each."""
    figure, grid = panel_grid(len(DISTANCES), 3.1, 2.5)
    for axes, name in zip(grid, DISTANCES, strict=True):
        ways = [np.array(way) / max(way[0], 1e-12) for way in found[name]["curves"]]
        for number, way in enumerate(ways):
            label, steps = "one episode" if number == 0 else None, np.arange(len(way)) - len(way) + 1
            axes.plot(steps, way, color=theme.series[-1], linewidth=0.8, alpha=0.6, label=label)
        longest = max(map(len, ways))
        padded = np.full((len(ways), longest), np.nan)
        for row, way in zip(padded, ways, strict=True):
            row[longest - len(way) :] = way
        steps = np.arange(longest) - longest + 1
        axes.plot(steps, np.nanmean(padded, 0), color=theme.series[0], linewidth=2.2, label="mean")
        axes.axhline(1, color=theme.text, linewidth=0.7, linestyle="--")
        axes.set_title(f"{name}: goal is the minimum in {100 * found[name]['goal_is_minimum']:.0f} %", fontsize=10)
        axes.set_xlabel("steps to the goal along the expert's way", fontsize=9)
        axes.set_ylim(bottom=0)
        style_axes(axes, theme)
    figure.axes[0].set_ylabel("distance, start = 1", fontsize=9)
    legend(figure, theme, ncols=2, fontsize=9)
    return figure_bytes(figure, theme)
