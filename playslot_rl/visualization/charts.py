"""Charts, each for a light or a dark page: success rates with intervals, loss and learning curves, codebook usage.

Colours are the Okabe-Ito palette, which colour-blind readers can tell apart.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from playslot_rl.colours import OKABE_ITO
from playslot_rl.config.methods import METHODS, Style
from playslot_rl.runtime.processes import here
from playslot_rl.storage.atomic import read_json, write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABEL: Final = "#767676"
"""Grey of labels on transparent pictures: legible on white and on the report's dark ground."""


@dataclass(frozen=True)
class Theme:
    """Colours of a chart on a light or a dark page; opaque, since files meet pages of other colours."""

    name: str
    ground: str
    text: str
    grid: str
    series: tuple[str, ...]


LIGHT: Final = Theme("light", "#ffffff", "#22262b", "#d8dbe0", OKABE_ITO)
DARK: Final = Theme(
    "dark",
    "#16181c",
    "#e4e6ea",
    "#3b4048",
    ("#4A97DE", "#E69F00", "#2FC79A", "#E39AC4", "#9AD1F3", "#F08A4B", "#F0E442", "#B5B5B5"),
)


_VARIANTS: Final = {"playslot_m": Style(4, "P")}
"""Of methods that are compared under another name."""


def style_of(method: str) -> Style | None:
    """How a method looks; None for what is none."""
    return METHODS[method].style if method in METHODS else _VARIANTS.get(method)


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches, without pyplot: no global state, no display needed."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def panel_grid(count: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of panels of so many inches, at most three in a row."""
    columns = min(3, count)
    rows = -(-count // columns)
    figure = new_figure(width * columns, height * rows)
    return figure, [figure.add_subplot(rows, columns, index + 1) for index in range(count)]


def figure_bytes(figure: Figure, theme: Theme, kind: str = "png", facts: Mapping[str, str] | None = None) -> bytes:
    """A figure as `png` or `svg`, the same bytes for the same figure; `facts` are stored as a PNG's text."""
    import matplotlib as mpl

    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else dict(facts or {})
    with mpl.rc_context({"svg.hashsalt": "playslot_rl", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=kind, dpi=144, facecolor=theme.ground, metadata=metadata)
    return buffer.getvalue()


def style_axes(axes: Axes, theme: Theme) -> None:
    """Colours of the page, a grid behind, and spines on two sides only."""
    axes.set_facecolor("none")
    axes.tick_params(colors=theme.text, labelsize=9, length=3)
    axes.xaxis.label.set_color(theme.text)
    axes.yaxis.label.set_color(theme.text)
    axes.title.set_color(theme.text)
    axes.grid(True, color=theme.grid, linewidth=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.grid)


def step_axis(axes: Axes) -> None:
    """Few ticks, thousands separated: long numbers side by side run into each other."""
    axes.locator_params(axis="x", nbins=6)
    axes.xaxis.set_major_formatter("{x:,.0f}")


def legend(figure: Figure, theme: Theme, **options: Any) -> None:
    """A legend outside the panels, with one entry for each label, however many of them have it."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    if entries:
        options = {"loc": "outside upper right", "frameon": False, "labelcolor": theme.text, **options}
        figure.legend(entries.values(), entries.keys(), **options)


def success_chart(rows: Sequence[tuple[str, float, tuple[float, float], str]], theme: Theme) -> bytes:
    """PNG of success rates: rows of label, rate, 95 % interval (0 to 1), and the method whose
    colour it has, or grey.
    """
    figure = new_figure(6.4, 0.6 + 0.42 * len(rows))
    axes = figure.add_subplot()
    for y, (_, rate, (low, high), method) in enumerate(rows):
        style = style_of(method)
        colour, marker, size = theme.series[7], "D", 7
        if style is not None:
            colour, marker, size = theme.series[style.colour], style.marker, 9
        axes.plot([100 * low, 100 * high], [y, y], color=colour, linewidth=3, solid_capstyle="round", alpha=0.6)
        axes.plot([100 * rate], [y], marker, color=colour, markersize=size)
        x, side = (100 * high + 2, "left") if rate <= 0.5 else (100 * low - 2, "right")
        axes.text(x, y, f"{100 * rate:.0f} %", color=theme.text, ha=side, va="center", fontsize=10)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(-3, 103)
    axes.set_xlabel("success rate, % (bar: 95 % Wilson interval)")
    style_axes(axes, theme)
    axes.grid(False, axis="y")
    return figure_bytes(figure, theme)


def loss_chart(histories: Mapping[str, Sequence[Mapping[str, Any]]], theme: Theme) -> bytes:
    """PNG of the loss over the optimiser step, one panel a stage and loss term, logarithmic, from the rows of each
    stage's `metrics.jsonl`; a ValueError where there is nothing to draw.
    """
    panels = [(stage, name) for stage, rows in histories.items() for name in loss_names(rows)]
    if not panels:
        raise ValueError("loss_chart: got no loss in the histories, expected at least one")
    figure, grid = panel_grid(len(panels), 3.1, 2.3)
    for axes, (stage, name) in zip(grid, panels, strict=True):
        for split, colour, marker in (("train", theme.series[0], ""), ("validation", theme.series[1], "o")):
            rows = [r for r in histories[stage] if r.get("split", "train") == split and name in r]
            if not rows:
                continue
            x, y = np.array([r["step"] for r in rows]), np.array([float(r[name]) for r in rows])
            axes.plot(x, y, color=colour, marker=marker, markersize=3.5, linewidth=1.4, label=split)
            if (y > 0).all():
                axes.set_yscale("log")
        axes.set_title(f"{stage}: {name.replace('_', ' ')}", fontsize=10)
        axes.set_xlabel("optimiser step", fontsize=9)
        style_axes(axes, theme)
        axes.tick_params(axis="y", which="minor", labelsize=7, colors=theme.text)
    legend(figure, theme, ncols=2)
    return figure_bytes(figure, theme)


def learning_chart(curves: Mapping[str, Sequence[Mapping[str, Any]]], random: Mapping[str, Any], theme: Theme) -> bytes:
    """PNG of two panels, mean return with its standard error and success rate with its 95 % interval (where the task
    measures any): points by method over their agent steps (`env_steps` of `curve.json`), and the random policy's. A
    ValueError where there is no point.
    """
    if not any(curves.values()):
        raise ValueError("learning_chart: got no points, expected at least one")
    solves = all(row["success_rate"] is not None for rows in (*curves.values(), [random]) for row in rows)
    figure = new_figure(6.8 if solves else 3.6, 2.8)
    left, *right = figure.subplots(1, 1 + solves, squeeze=False)[0]
    for method, rows in curves.items():
        style = style_of(method)
        colour = theme.series[6] if style is None else theme.series[style.colour]
        steps, mean, error = (
            np.array([row[key] for row in rows]) for key in ("env_steps", "return_mean", "return_error")
        )
        bands = [(left, mean, mean - error, mean + error)]
        for axes in right:
            low, high = 100 * np.array([row["ci95"] for row in rows]).reshape(-1, 2).T
            bands.append((axes, 100 * np.array([row["success_rate"] for row in rows]), low, high))
        for axes, values, lower, upper in bands:
            label = (METHODS[method].title if method in METHODS else method) if axes is left else None
            axes.plot(steps, values, color=colour, marker="o", markersize=3.5, linewidth=1.5, label=label)
            axes.fill_between(steps, lower, upper, color=colour, alpha=0.2, linewidth=0)
    grey = theme.series[-1]
    left.axhline(random["return_mean"], color=grey, linestyle="--", linewidth=1.3, label="random policy")
    left.set_ylabel("return of an episode", fontsize=9)
    for axes in right:
        axes.axhline(100 * random["success_rate"], color=grey, linestyle="--", linewidth=1.3)
        axes.set_ylabel("success rate, %", fontsize=9)
        axes.set_ylim(-3, 103)
    for axes in (left, *right):
        axes.set_xlabel("agent steps", fontsize=9)
        step_axis(axes)
        style_axes(axes, theme)
    legend(figure, theme, ncols=4, fontsize=9)
    return figure_bytes(figure, theme)


def draw_curve(folder: Path, method: str) -> None:
    """Draw `curve.json` of a method's training, where it has one, as `curve_light.png` and `curve_dark.png`."""
    if (folder / "curve.json").is_file() and here().first:
        curve = read_json(folder / "curve.json")
        for theme in (LIGHT, DARK):
            chart = learning_chart({method: curve["rows"]}, curve["random"], theme)
            write_bytes(folder / f"curve_{theme.name}.png", chart)


def curve_figure(panels: Mapping[str, Mapping[str, Sequence[float] | np.ndarray[Any, Any]]], theme: Theme) -> Figure:
    """Numbers over the frames of an episode, feature -> component -> one value a frame: at most three panels in a row,
    legends beside them. A ValueError where there is nothing to draw.
    """
    if not panels:
        raise ValueError("curve_figure: got no feature, expected at least one")
    figure, grid = panel_grid(len(panels), 3.9, 2.2)
    for axes, (name, lines) in zip(grid, panels.items(), strict=True):
        for number, (label, values) in enumerate(lines.items()):
            colour = theme.series[number % len(theme.series)]
            axes.plot(np.arange(len(values)), values, color=colour, linewidth=1.3, label=_literal(label))
        axes.set_title(_literal(name), fontsize=10)
        axes.set_xlabel("frame", fontsize=9)
        style_axes(axes, theme)
        if 1 < len(lines) <= len(theme.series):
            axes.legend(frameon=False, labelcolor=theme.text, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _literal(name: str) -> str:
    """A name from a data set as it is: a dollar sign would begin a formula."""
    return name.replace("$", r"\$")


def loss_names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of loss terms in a history: `loss` first, then `loss_...` in the order of appearance."""
    names = dict.fromkeys(k for r in rows for k in r if k == "loss" or k.startswith("loss_"))
    terms = [n for n in names if n != "loss"]
    # With a single term the sum is the same curve, and it is the one that is validated.
    return ["loss"] if "loss" in names and len(terms) == 1 else [n for n in names if n == "loss"] + terms


def usage_chart(counts: Sequence[int], theme: Theme) -> bytes:
    """PNG of the share of transitions for each code, of K counts."""
    figure = new_figure(6.4, 2.4)
    axes = figure.add_subplot()
    axes.bar(np.arange(len(counts)), 100 * np.array(counts) / max(1, sum(counts)), 0.74, color=theme.series[0])
    axes.set_xticks(range(len(counts)))
    axes.set_xlabel("code")
    axes.set_ylabel("transitions, %")
    style_axes(axes, theme)
    axes.grid(False, axis="x")
    return figure_bytes(figure, theme)
