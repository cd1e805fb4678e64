"""`video.png` and `.svg`, and sheets of predicted frames.

Shapes: P predicted frames, H W image height and width.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from playslot_rl.studies.study import Result
from playslot_rl.studies.video.page import RECONSTRUCTION, heading
from playslot_rl.visualization.charts import Theme, legend, new_figure, style_axes, style_of
from playslot_rl.visualization.grid import image_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image


def video_figure(result: Result, theme: Theme) -> Figure:
    """PSNR and SSIM over the predicted step, one row of panels a test set and number of seed frames."""
    from matplotlib.ticker import MaxNLocator

    shown = list(itertools.product(result["tested_on"], result["seed_frames"]))
    figure = new_figure(9.6, 0.6 + 3.1 * len(shown))
    steps = np.arange(1, result["predicted_frames"] + 1)
    for i, (clips, number) in enumerate(shown):
        for j, (name, label) in enumerate((("psnr", "PSNR, dB"), ("ssim", "SSIM"))):
            axes = figure.add_subplot(len(shown), 2, 2 * i + j + 1)
            here = [r for r in result["summary"] if (r["clips_of"], r["seed_frames"]) == (clips, number)]
            rows = [row for row in here if not row["row"]]
            variants = [row["title"] for row in rows if row["variant"]]
            for row in rows:
                _curve(axes, steps, row, name, theme, variants)
            axes.set_title(heading(clips, number), color=theme.text, fontsize=10)
            axes.set_xlabel("predicted frame")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_ylabel(label)
            style_axes(axes, theme)
    legend(figure, theme, loc="outside lower center", ncols=4, fontsize=9)
    return figure


def _curve(
    axes: Any, steps: npt.NDArray[np.int64], row: Result, name: str, theme: Theme, variants: Sequence[str]
) -> None:
    style = style_of(row["method"] or "")
    number = 7 if style is None else style.colour
    if row["variant"]:  # of one method: each has a colour of its own
        number = variants.index(row["title"]) % 7
    colour = theme.series[number]
    line = "-" if style is not None else "--" if row["title"] == RECONSTRUCTION else ":"
    low, high = np.asarray(row[f"{name}_steps_ci95"]).T
    axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
    marker = "" if style is None else style.marker
    label = row["title"]
    axes.plot(steps, row[f"{name}_steps"], line, color=colour, marker=marker, markersize=4, linewidth=1.4, label=label)


def video_sheet(
    truth: npt.NDArray[np.uint8], predictions: Mapping[str, npt.NDArray[np.uint8]], columns: int = 6
) -> Image.Image:
    """True frames (clips, P, H, W, 3) and each model's, by title: the first clips of the test, not chosen; of each so
    many frames, evenly spread.
    """
    at = np.unique(np.linspace(0, truth.shape[1] - 1, min(columns, truth.shape[1])).round().astype(int))
    strips: list[npt.NDArray[np.uint8]] = []
    labels: list[str] = []
    for clip in range(len(truth)):
        for title, frames in {"true": truth, **predictions}.items():
            strips.append(frames[clip, at])
            labels.append(title)
    return image_grid(np.stack(strips), labels, [f"+{step + 1}" for step in at])
