"""Pictures of planning: start, goal, what the first plan imagined and what was executed; and the cost along solutions.

Shapes: T steps, H horizon, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from playslot_rl.evaluation.goals import Frames
from playslot_rl.visualization.charts import Theme, figure_bytes, legend, new_figure, style_axes
from playslot_rl.visualization.grid import image_grid

COLUMNS = 8


def plan_sheet(goals: Sequence[Frames], plans: Sequence[Frames], executed: Sequence[Frames]) -> Image.Image:
    """Two rows an episode: start and goal, then the first plan as it was imagined over what was executed.

    Args:
        goals: the expert's way to each goal (T + 1, H, W, 3).
        plans: imagined frames (H + 1, H, W, 3), an episode each.
        executed: frames (T' + 1, H, W, 3); where an episode ended before the horizon its last one is repeated.
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
    """Each distance to the goal along the expert's way, in units of its value at the start: a panel each.

    Args:
        found: what `cost_along_solution` found.
        theme: page.

    Returns:
        PNG.
    """
    names = ("slots", "dynamics", "image")
    figure = new_figure(3.1 * len(names), 2.5)
    for index, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), index + 1)
        ways = [np.array(way) / max(way[0], 1e-12) for way in found[name]["curves"]]
        for number, way in enumerate(ways):
            label = "one episode" if number == 0 else None
            axes.plot(
                np.arange(len(way)) - len(way) + 1, way, color=theme.series[-1], linewidth=0.8, alpha=0.6, label=label
            )
        longest = max(map(len, ways))
        padded = np.full((len(ways), longest), np.nan)
        for row, way in zip(padded, ways, strict=True):
            row[longest - len(way) :] = way
        axes.plot(
            np.arange(longest) - longest + 1, np.nanmean(padded, 0), color=theme.series[0], linewidth=2.2, label="mean"
        )
        axes.axhline(1, color=theme.text, linewidth=0.7, linestyle="--")
        axes.set_title(f"{name}: goal is the minimum in {100 * found[name]['goal_is_minimum']:.0f} %", fontsize=10)
        axes.set_xlabel("steps to the goal along the expert's way", fontsize=9)
        axes.set_ylim(bottom=0)
        style_axes(axes, theme)
    figure.axes[0].set_ylabel("distance, start = 1", fontsize=9)
    legend(figure, theme, ncols=2, fontsize=9)
    return figure_bytes(figure, theme)
