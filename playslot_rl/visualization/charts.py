"""Charts: success rates with intervals, loss curves, codebook usage. Each is drawn for a light and for a dark page."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from playslot_rl.visualization.palette import METHOD_STYLES, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def _figure(width: float, height: float) -> Figure:
    # Figure without pyplot: no global state, no display needed.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _style(axes: Axes, theme: Theme) -> None:
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


def _step_axis(axes: Axes) -> None:
    """Few ticks, thousands separated: long numbers side by side run into each other."""
    axes.locator_params(axis="x", nbins=6)
    axes.xaxis.set_major_formatter("{x:,.0f}")


def _png(figure: Figure, theme: Theme) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=144, facecolor=theme.ground)
    return buffer.getvalue()


def success_chart(rows: Sequence[tuple[str, float, tuple[float, float], str]], theme: Theme) -> bytes:
    """Success rates in per cent with their 95 % intervals.

    Args:
        rows: label, rate (0 to 1), interval (0 to 1), and the method, in whose colour it is drawn (others are grey).
        theme: page.

    Returns:
        PNG.
    """
    figure = _figure(6.4, 0.6 + 0.42 * len(rows))
    axes = figure.add_subplot()
    for y, (_, rate, (low, high), method) in enumerate(rows):
        style = METHOD_STYLES.get(method)
        colour = theme.series[7 if style is None else style.colour]
        axes.plot([100 * low, 100 * high], [y, y], color=colour, linewidth=3, solid_capstyle="round", alpha=0.6)
        axes.plot(
            [100 * rate],
            [y],
            "D" if style is None else style.marker,
            color=colour,
            markersize=7 if style is None else 9,
        )
        right = rate <= 0.5
        x = 100 * high + 2 if right else 100 * low - 2
        axes.text(
            x, y, f"{100 * rate:.0f} %", color=theme.text, ha="left" if right else "right", va="center", fontsize=10
        )
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(-3, 103)
    axes.set_xlabel("success rate, % (bar: 95 % Wilson interval)")
    _style(axes, theme)
    axes.grid(False, axis="y")
    return _png(figure, theme)


def loss_chart(histories: Mapping[str, Sequence[Mapping[str, Any]]], theme: Theme, columns: int = 3) -> bytes:
    """Loss against the optimiser step, one panel a stage and loss term, logarithmic.

    Args:
        histories: stage -> rows of its `metrics.jsonl` (`step`, `split`, numbers).
        theme: page.
        columns: panels side by side.

    Returns:
        PNG.

    Raises:
        ValueError: there is nothing to draw.
    """
    panels = [(stage, name) for stage, rows in histories.items() for name in loss_names(rows)]
    if not panels:
        raise ValueError("loss_chart: got no loss in the histories, expected at least one")
    columns = min(columns, len(panels))
    height = -(-len(panels) // columns)
    figure = _figure(3.1 * columns, 2.3 * height)
    handles: dict[str, Any] = {}
    for index, (stage, name) in enumerate(panels):
        axes = figure.add_subplot(height, columns, index + 1)
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
        _style(axes, theme)
        axes.tick_params(axis="y", which="minor", labelsize=7, colors=theme.text)
        handles |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper right", ncols=2, frameon=False, labelcolor=theme.text
    )
    return _png(figure, theme)


def curve_chart(panels: Mapping[str, Mapping[str, Sequence[float] | np.ndarray[Any, Any]]], theme: Theme) -> bytes:
    """Numbers over the frames of an episode, one panel a feature and one line a component.

    Args:
        panels: feature -> component -> one value a frame.
        theme: page.

    Returns:
        PNG.

    Raises:
        ValueError: there is nothing to draw.
    """
    if not panels:
        raise ValueError("curve_chart: got no feature, expected at least one")
    figure = _figure(3.1 * len(panels), 2.2)
    for index, (name, lines) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), index + 1)
        for number, (label, values) in enumerate(lines.items()):
            colour = theme.series[number % len(theme.series)]
            axes.plot(np.arange(len(values)), values, color=colour, linewidth=1.3, label=label)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("frame", fontsize=9)
        _style(axes, theme)
        if 1 < len(lines) <= len(theme.series):
            axes.legend(frameon=False, labelcolor=theme.text, fontsize=7, ncols=2)
    return _png(figure, theme)


def loss_names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of loss terms in a history: `loss` first, then `loss_...` in the order of appearance."""
    names = dict.fromkeys(k for r in rows for k in r if k == "loss" or k.startswith("loss_"))
    terms = [n for n in names if n != "loss"]
    # With a single term the sum is the same curve, and it is the one that is validated.
    return ["loss"] if "loss" in names and len(terms) == 1 else [n for n in names if n == "loss"] + terms


def usage_chart(counts: Mapping[str, Sequence[int]], theme: Theme) -> bytes:
    """Share of transitions for each code, in per cent, one series a data set.

    Args:
        counts: data set -> K counts.
        theme: page.

    Returns:
        PNG.
    """
    figure = _figure(6.4, 2.4)
    axes = figure.add_subplot()
    k = max(len(c) for c in counts.values())
    width = 0.8 / len(counts)
    for i, (name, values) in enumerate(counts.items()):
        share = 100 * np.array(values) / max(1, sum(values))
        axes.bar(
            np.arange(len(values)) + (i - (len(counts) - 1) / 2) * width,
            share,
            width * 0.92,
            color=theme.series[i],
            label=name,
        )
    axes.set_xticks(range(k))
    axes.set_xlabel("code")
    axes.set_ylabel("transitions, %")
    _style(axes, theme)
    axes.grid(False, axis="x")
    if len(counts) > 1:
        figure.legend(loc="outside upper right", ncols=4, frameon=False, labelcolor=theme.text, fontsize=9)
    return _png(figure, theme)
