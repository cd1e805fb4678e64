"""Learning curves: return and success against agent steps, the random policy beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from playslot_rl.config.methods import METHODS
from playslot_rl.visualization.charts import _figure, _png, _step_axis, _style
from playslot_rl.visualization.palette import METHOD_STYLES, Theme


def learning_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]], random: Mapping[str, Any], theme: Theme) -> bytes:
    """Two panels: mean return with its standard error, and success rate with its 95 % interval.

    Args:
        curves: method, by its name in `playslot_rl.config.methods` (others in a colour of no method) -> points
            with `env_steps`, `return_mean`, `return_error`, `success_rate`, `ci95`.
        random: the random policy's point.
        theme: page.

    Returns:
        PNG.

    Raises:
        ValueError: there is no point.
    """
    if not any(curves.values()):
        raise ValueError("learning_chart: got no points, expected at least one")
    figure = _figure(6.8, 2.8)
    left, right = figure.subplots(1, 2)
    titles = {name: method.title for name, method in METHODS.items()}
    for method, rows in curves.items():
        style = METHOD_STYLES.get(method)
        colour = theme.series[6] if style is None else theme.series[style.colour]
        name = titles.get(method, method)
        steps = np.array([row["env_steps"] for row in rows])
        mean = np.array([row["return_mean"] for row in rows])
        error = np.array([row["return_error"] for row in rows])
        left.plot(steps, mean, color=colour, marker="o", markersize=3.5, linewidth=1.5, label=name)
        left.fill_between(steps, mean - error, mean + error, color=colour, alpha=0.2, linewidth=0)
        low, high = (100 * np.array([row["ci95"][side] for row in rows]) for side in (0, 1))
        rate = 100 * np.array([row["success_rate"] for row in rows])
        right.plot(steps, rate, color=colour, marker="o", markersize=3.5, linewidth=1.5)
        right.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
    grey = theme.series[-1]
    left.axhline(random["return_mean"], color=grey, linestyle="--", linewidth=1.3, label="random policy")
    right.axhline(100 * random["success_rate"], color=grey, linestyle="--", linewidth=1.3)
    left.set_ylabel("return of an episode", fontsize=9)
    right.set_ylabel("success rate, %", fontsize=9)
    right.set_ylim(-3, 103)
    for axes in (left, right):
        axes.set_xlabel("agent steps", fontsize=9)
        _step_axis(axes)
        _style(axes, theme)
    figure.legend(loc="outside upper right", ncols=4, frameon=False, labelcolor=theme.text, fontsize=9)
    return _png(figure, theme)
