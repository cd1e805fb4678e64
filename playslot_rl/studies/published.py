"""Returns over training held against published ones: is an implementation as good as its authors'?

What is compared is what the authors log: the undiscounted return of the episodes that the agent learns from, exploring,
against frames, which are steps of the simulator (`env.frame_skip` to an agent step).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from playslot_rl.errors import DataError
from playslot_rl.training.logging import History
from playslot_rl.visualization.charts import DARK, LIGHT, Theme, figure_bytes, legend, new_figure, step_axis, style_axes
from playslot_rl.visualization.document import Document, Picture, Section, Table, write_document

if TYPE_CHECKING:
    from playslot_rl.config import EnvConfig

Verdict = Literal["in the band", "below", "above", "not reached"]
Curve = Sequence[tuple[int, float]]
"""Frames at the end of an episode, and its return."""

WIDTH: Final = 10_000
SOURCE: Final = (
    "DreamerV3 on DeepMind Control from pixels, action repeat 2, ten seeds: danijar/dreamerv3, "
    "scores/dmc_vision-dreamerv3.json.gz at e3f0224; mean of a seed's training episodes in the window, mean, lowest "
    "and highest of the seeds"
)


@dataclass(frozen=True)
class Band:
    """Published returns around `frames`: over `WIDTH` frames, the seeds' mean, lowest and highest."""

    frames: int
    mean: float
    low: float
    high: float

    def of(self, curve: Curve) -> float | None:
        """The mean return of a curve in this window; None where it has no episode there, or stops short of it."""
        found = [value for frames, value in curve if -WIDTH < 2 * (frames - self.frames) <= WIDTH]
        reached = bool(curve) and 2 * (curve[-1][0] - self.frames) >= WIDTH
        return float(np.mean(found)) if found and reached else None

    def verdict(self, value: float | None) -> Verdict:
        """Where a mean return lies."""
        if value is None:
            return "not reached"
        return "below" if value < self.low else "above" if value > self.high else "in the band"


def _bands(*rows: tuple[int, int, int]) -> tuple[Band, ...]:
    return tuple(Band(WIDTH * i, *row) for i, row in enumerate(rows, 1))


DREAMER: Final[Mapping[str, tuple[Band, ...]]] = {
    "dmc_cartpole_balance": _bands(
        (290, 268, 317), (304, 236, 346), (485, 319, 568), (567, 433, 643), (613, 543, 680), (751, 632, 929),
        (876, 671, 974), (916, 770, 974), (939, 870, 979), (946, 867, 979), (965, 919, 985), (974, 950, 987),
        (979, 967, 988), (981, 971, 989), (979, 967, 989),
    ),
    "dmc_ball_in_cup_catch": _bands(
        (14, 0, 52), (100, 0, 212), (192, 0, 716), (437, 0, 886), (472, 0, 886), (650, 43, 920), (789, 172, 943),
        (832, 221, 968), (862, 522, 955), (877, 552, 954), (910, 771, 950), (920, 722, 961), (934, 853, 963),
        (946, 901, 960), (936, 801, 968),
    ),
}  # fmt: skip
"""DreamerV3's by task (`SOURCE`), around 10,000, 20,000, ... frames."""
CURVES: Final = {"dreamer": DREAMER}
"""By method."""


def read_curve(folder: Path, env: EnvConfig) -> list[tuple[int, float]]:
    """Of `RUN/METHOD`, also while it trains; a DataError where no episode has been played.

    A round's episodes are one point, their mean.
    """
    rows = [row for row in History(folder / "metrics.jsonl").read() if row["split"] == "acting"]
    if not rows:
        raise DataError(f"{folder}: got no episodes in metrics.jsonl, expected a method that learns by acting")
    return [(row["step"] * env.frame_skip, float(row["return"])) for row in rows]


def against(curves: Sequence[Curve], bands: Sequence[Band]) -> list[tuple[Band, float | None, Verdict]]:
    """For each window the mean over seeds, of those windows that all of them have reached."""
    found = []
    for band in bands:
        values = [band.of(curve) for curve in curves]
        known = [value for value in values if value is not None]
        mean = float(np.mean(known)) if known and len(known) == len(values) else None
        found.append((band, mean, band.verdict(mean)))
    return found


def band_chart(curves: Mapping[str, Curve], bands: Sequence[Band], theme: Theme) -> bytes:
    """PNG: every episode of each seed, the seeds' windows, and the published mean in its band."""
    figure = new_figure(6.8, 3.4)
    axes = figure.subplots()
    frames = [band.frames for band in bands]
    grey = theme.series[-1]
    axes.fill_between(frames, [b.low for b in bands], [b.high for b in bands], color=grey, alpha=0.25, linewidth=0)
    axes.plot(frames, [band.mean for band in bands], color=grey, linewidth=1.5, label="published mean and range")
    for number, (name, curve) in enumerate(curves.items()):
        colour = theme.series[number % (len(theme.series) - 1)]
        axes.plot(*zip(*curve, strict=True), ".", color=colour, markersize=2.5, alpha=0.5)
        means = [(band.frames, mean) for band in bands if (mean := band.of(curve)) is not None]
        axes.plot([f for f, _ in means], [m for _, m in means], "o-", color=colour, markersize=3.5, label=name)
    axes.set_xlabel("frames", fontsize=9)
    axes.set_ylabel("return of an episode", fontsize=9)
    step_axis(axes)
    style_axes(axes, theme)
    legend(figure, theme, ncols=3, fontsize=9)
    return figure_bytes(figure, theme)


def write_page(curves: Mapping[str, Curve], env: str, folder: Path) -> Path:
    """`FOLDER/published.html`, and as Markdown: curves of seeds, by their names, against DreamerV3's."""
    bands = DREAMER[env]
    rows = [
        [f"{b.frames:,}", f"{b.mean:.0f}", f"{b.low:.0f} to {b.high:.0f}", "-" if m is None else f"{m:.0f}", verdict]
        for b, m, verdict in against(list(curves.values()), bands)
    ]
    light, dark = (band_chart(curves, bands, theme) for theme in (LIGHT, DARK))
    words = (
        f"The training episodes of {len(curves)} seed{'s' * (len(curves) > 1)} against the published ones. {SOURCE}."
    )
    table = Table(("frames", "published", "lowest to highest", "here", ""), rows, f"Windows of {WIDTH:,} frames.")
    picture = Picture("published", light, f"Return over frames on {env}, in or out of the published band", "", dark)
    document = Document(f"DreamerV3 on {env}", words, (Section("Returns", (picture, table)),))
    return write_document(document, folder, "published")


def summary(curves: Sequence[Curve], env: str) -> str:
    """A line: the last window that is reached."""
    reached = [(band, mean, said) for band, mean, said in against(curves, DREAMER[env]) if mean is not None]
    if not reached:
        return (
            f"published returns on {env}: no window is reached, the first is around {DREAMER[env][0].frames:,} frames"
        )
    band, mean, said = reached[-1]
    return (
        f"return {mean:.0f} around {band.frames:,} frames, published {band.mean:.0f} ({band.low:.0f} to "
        f"{band.high:.0f}): {said}"
    )
