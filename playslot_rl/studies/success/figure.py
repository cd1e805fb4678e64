"""`comparison.png` and `.svg`: success against demonstrations, labels or videos, and against environment steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from playslot_rl.config.methods import METHODS
from playslot_rl.studies.study import Result
from playslot_rl.studies.success.errors import TITLES, error_references
from playslot_rl.studies.success.page import Panel, budgeted, panels
from playslot_rl.visualization.charts import Theme, legend, new_figure, panel_grid, step_axis, style_axes

REFERENCES = dict(zip(TITLES.values(), (":", "--"), strict=True))
AXES = {"demos": "demonstrations", "labels": "labelled demonstrations", "videos": "unlabelled videos of demonstrations"}

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def success_figure(result: Result, theme: Theme) -> Figure:
    """Draw what `comparison.json` holds.

    A method has its colour and marker everywhere; imagination is dashed. Bars are the 95 % intervals, small dots single
    runs, the grey lines the references.
    """
    curves = [row for row in result["rows"] if row["curve"]]
    final = [row for row in result["summary"] if row["demos"] is None]
    online = bool(curves or final)
    groups = panels(result) or ([] if online else [Panel("", "", "demos", "", [], [], [])])
    count = len(groups) + int(online)
    figure = new_figure(9.6 if count > 1 else 6.4, 3.9)
    for number, panel in enumerate(groups, 1):
        axes = figure.add_subplot(1, count, number)
        axes.set_title(panel.title, color=theme.text, fontsize=10)
        _against(axes, panel, theme)
        _finish(axes, result, theme)
    if online:
        axes = figure.add_subplot(1, count, count)
        _steps(axes, curves, [{**row, "title": budgeted(row, result)} for row in final], theme)
        _finish(axes, result, theme)
    legend(figure, theme, loc="outside lower center", ncols=3, fontsize=9)
    return figure


def tasks_figure(results: Mapping[str, Result], theme: Theme) -> Figure:
    """The last panel, of most demonstrations or labels, of every task's figure; none of tasks that learn from none."""
    shown = {task: found[-1] for task, result in results.items() if (found := panels(result))}
    figure, places = panel_grid(max(1, len(shown)), 4.2, 3.2)
    for axes, (task, panel) in zip(places, shown.items(), strict=False):
        axes.set_title("\n".join(filter(None, (task, panel.title))), color=theme.text, fontsize=10)
        _against(axes, panel, theme)
        _finish(axes, results[task], theme)
    legend(figure, theme, loc="outside lower center", ncols=3, fontsize=9)
    return figure


def _against(axes: Axes, panel: Panel, theme: Theme) -> None:
    """Success, or the error, over the panel's axis; what is alike for all of its numbers is a line across."""
    key, scale = ("mae", 1) if any("mae" in row for row in panel.rows) else ("success_rate", 100)
    for row in (row for row in panel.rows if row["at"] is None):
        colour = theme.series[METHODS[row["method"]].style.colour]
        axes.axhline(scale * row[key], color=colour, linestyle="-.", linewidth=1.2, label=row["title"])
    shown = [row for row in panel.rows if row["at"] is not None]
    series = list(dict.fromkeys((row["method"], row["protocol"], row["title"]) for row in shown))
    numbers = sorted({row["at"] for row in shown})
    for index, (method, protocol, title) in enumerate(series):
        style, own = METHODS[method].style, [r for r in shown if (r["method"], r["protocol"]) == (method, protocol)]
        own.sort(key=lambda row: row["at"])
        # Side by side, so that equal rates do not hide each other; by a factor, since the axis is logarithmic.
        aside = 1.035 ** (index - (len(series) - 1) / 2)
        x, y = [row["at"] * aside for row in own], [scale * row[key] for row in own]
        below = [max(0.0, scale * (row[key] - row["ci95"][0])) for row in own]
        above = [max(0.0, scale * (row["ci95"][1] - row[key])) for row in own]
        dream = protocol == "imagination"
        colour = theme.series[style.colour]
        axes.errorbar(
            x, y, [below, above], color=colour, marker=style.marker, markersize=6, linewidth=1.6,
            linestyle="--" if dream else "-", markerfacecolor=theme.ground if dream else colour, capsize=2,
            elinewidth=1.2, label=f"{title}, imagination" if dream else title,
        )  # fmt: skip
        single = [r for r in panel.jobs if (r["method"], r["protocol"]) == (method, protocol) and r["at"] is not None]
        single = [row for row in single if row.get(key) is not None]
        if len({(row["world"], row["seed"]) for row in single}) > 1:
            dots = [row["at"] * aside for row in single]
            axes.plot(dots, [scale * row[key] for row in single], ".", color=colour, markersize=4, alpha=0.5)
    for title, line in REFERENCES.items() if key == "mae" else ():
        own = sorted((row for row in error_references(panel.rows) if row["title"] == title), key=lambda row: row["at"])
        x, y = [row["at"] for row in own], [row[key] for row in own]
        axes.plot(x, y, color=theme.series[7], linestyle=line, linewidth=1.2, marker="|", label=title.strip("()"))
    if numbers and numbers[0] == 0:
        axes.set_xscale("symlog", linthresh=min(numbers[1:], default=1))
    else:
        axes.set_xscale("log")
    axes.set_xticks(numbers, [str(n) for n in numbers])
    axes.minorticks_off()
    axes.set_xlabel(AXES[panel.axis])


def _steps(axes: Axes, curves: Sequence[Result], final: Sequence[Result], theme: Theme) -> None:
    for method in dict.fromkeys(row["method"] for row in [*curves, *final]):
        style = METHODS[method].style
        colour = theme.series[style.colour]
        own = [row for row in curves if row["method"] == method]
        for row in own:
            points = [p for p in row["curve"] if p.get("success_rate") is not None and p.get("env_steps") is not None]
            x = [p["env_steps"] for p in points]
            axes.plot(x, [100 * p["success_rate"] for p in points], color=colour, linewidth=1.2, alpha=0.6)
        for end in (row for row in final if row["method"] == method and row["env_steps"] is not None):
            low, high = end["ci95"]
            error = [[100 * (end["success_rate"] - low)], [100 * (high - end["success_rate"])]]
            axes.errorbar(
                [end["env_steps"]], [100 * end["success_rate"]], error, color=colour, marker=style.marker,
                markersize=7, linestyle="none", capsize=2, label=end["title"],
            )  # fmt: skip
        dots = [r for r in own if r["env_steps"] is not None and r["success_rate"] is not None]
        if len(dots) > 1:
            rates = [100 * r["success_rate"] for r in dots]
            axes.plot([r["env_steps"] for r in dots], rates, ".", color=colour, markersize=4, alpha=0.5)
        if not any(row["method"] == method and row["env_steps"] is not None for row in final):
            axes.plot([], [], color=colour, marker=style.marker, label=(own or list(final))[0]["title"])
    step_axis(axes)
    axes.set_xlabel("environment steps (lines: development episodes)")


def _finish(axes: Axes, result: Result, theme: Theme) -> None:
    for name, line in (("expert", ":"), ("random", "--")):
        rate = result["references"].get(name, {}).get("success_rate")
        if rate is not None:
            axes.axhline(100 * rate, color=theme.series[7], linestyle=line, linewidth=1.2, label=f"{name} actions")
    if result.get("measure") == "actions":
        axes.set_ylim(bottom=0)
        axes.set_ylabel("mean absolute error of actions")
    else:
        axes.set_ylim(-3, 103)
        axes.set_ylabel("success rate, %")
    style_axes(axes, theme)
