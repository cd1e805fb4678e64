"""`video.md`: scores, what the trainings cost, and footnotes; `video.png` and `.svg`, and sheets of predicted frames.

Shapes: P predicted frames, H W image height and width.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from playslot_rl.runtime.progress import format_seconds
from playslot_rl.studies.study import FOOTNOTES, Result, machine_note, open_jobs_notes, origin_notes
from playslot_rl.studies.video.shared import RECONSTRUCTION, sheet_name
from playslot_rl.visualization.charts import Theme, legend, new_figure, style_axes, style_of
from playslot_rl.visualization.document import Block, Document, Linked, Notes, Section, Table
from playslot_rl.visualization.grid import image_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image


PAPER = {
    "block_push": {"svg": "20.96 / 0.898", "caddy": "21.18 / 0.901", "slotformer": "17.22 / 0.729",
                   "ocvp_seq": "17.26 / 0.751", "playslot": "21.41 / 0.890"},
    "button_press": {"svg": "32.23 / 0.950", "caddy": "24.58 / 0.853", "slotformer": "19.52 / 0.762",
                     "ocvp_seq": "19.55 / 0.762", "playslot": "26.03 / 0.878"},
    "grid_shapes": {"svg": "38.10 / 0.988", "caddy": "39.16 / 0.986", "slotformer": "19.74 / 0.795",
                    "ocvp_seq": "18.86 / 0.791", "playslot_m": "54.09 / 0.996"},
    "sketchy": {"svg": "24.24 / 0.813", "caddy": "23.65 / 0.809", "slotformer": "21.17 / 0.751",
                "ocvp_seq": "21.23 / 0.751", "playslot": "24.43 / 0.815"},
}  # fmt: skip
"""PSNR and SSIM of the paper's Table 1 (6 seed frames, 15 predicted); larger models, other renderings, days of GPU."""


def video_page(result: Result) -> Document:
    trained, budget = result["trained"], result["budget_minutes"]
    after = f"After {budget:g} minutes of training" if budget else "After the preset's steps"
    lead = (
        f"**{after}**, and SAVi's {format_seconds(result['slots_seconds'])} for models on slots. "
        if result["slots_seconds"]
        else f"**{after}.** "
    )
    episodes = ", ".join(map(str, sorted({row["episodes"] for row in result["summary"]})))
    lead += (
        f"Preset `{result['preset']}`, training seeds {', '.join(map(str, result['seeds']))}; clips of "
        f"{trained['seed_frames']} and {trained['predicted_frames']} frames in training, the same videos for every "
        f"method. Tested on {result['predicted_frames']} predicted frames of clips of episodes that no training and "
        "no validation saw. Means over frames, clips and seeds; in brackets the 95 % bootstrap interval over seeds "
        f"and episodes ({episodes}). What a model is told of the true future is a column: latents are inferred from "
        "it, as in the paper."
    )
    sections = []
    for label in result["tested_on"]:
        blocks: list[Block] = [_scores(result, label)]
        for shown in result["seed_frames"]:
            alt = f"{heading(label, shown)}: true, and each model's"
            blocks.append(Linked(alt, f"{sheet_name(label, shown)}.png"))
        sections.append(Section(f"{label} clips" if label else "Scores", blocks))
    sections += [Section("Training", [_trainings(result)]), Section(FOOTNOTES, [Notes(_notes(result))])]
    plot = Linked("PSNR and SSIM over the step", "video.png")
    return Document(f"{result['env']}: video prediction", lead, sections, [plot])


def objects_page(found: Mapping[str, Result]) -> Document:
    first = next(iter(found.values()))
    lead = (
        "PSNR in dB and SSIM over the predicted frames; each number has its videos, its SAVi and a page of its own, "
        "with intervals: " + ", ".join(f"[{number}](objects_{number}/video.md)" for number in found) + "."
    )
    sections = []
    for shown in first["seed_frames"]:
        cells: dict[str, dict[str, str]] = {}
        for number, result in found.items():
            for row in result["summary"]:
                if row["seed_frames"] == shown:
                    cells.setdefault(_title(row), {})[number] = f"{row['psnr']:.2f} / {row['ssim']:.3f}"
        body = [[title, *(values.get(number, "–") for number in found)] for title, values in cells.items()]
        sections.append(Section(heading("", shown), [Table(["objects", *found], body)]))
    return Document(f"{first['env']}: video prediction over the number of objects", lead, sections)


def _title(row: Result) -> str:
    return f"{row['title']}, {row['row']}" if row["row"] else str(row["title"])


def heading(label: str, shown: int) -> str:
    frames = f"{shown} seed frame{'s' if shown > 1 else ''}"
    return f"{label} clips, {frames}" if label else frames


def _scores(result: Result, label: str) -> Table:
    """A line a model, the numbers of seed frames side by side."""
    lines: dict[str, dict[int, Result]] = {}
    rows = [row for row in result["summary"] if row["clips_of"] == label]
    rows.sort(
        key=lambda row: (row["method"] is not None, result["methods"].index(row["method"]) if row["method"] else 0)
    )
    for row in rows:
        lines.setdefault(_title(row), {})[row["seed_frames"]] = row
    columns = list(itertools.product(result["seed_frames"], ("psnr", "ssim", "lpips")))
    if result["lpips"] != "available":
        columns = [(shown, name) for shown, name in columns if name != "lpips"]
    units = {"psnr": "PSNR after {}, dB", "ssim": "SSIM after {}", "lpips": "LPIPS after {}"}
    body = []
    for title, by_seed_frames in lines.items():
        scores = [_cell(by_seed_frames[shown], name) for shown, name in columns]
        first = next(iter(by_seed_frames.values()))
        body.append([title, *scores, first["sees"], _papers(result, by_seed_frames.get(6, first))])
    headers = ["", *(units[name].format(shown) for shown, name in columns), "told of the true future"]
    headers.append("the paper's PSNR / SSIM after 6")
    if all(line[-1] == "–" for line in body):
        headers, body = headers[:-1], [line[:-1] for line in body]
    return Table(headers, body)


def _papers(result: Result, row: Result) -> str:
    """What the paper reports in this place, `–` where nothing."""
    asked = row["seed_frames"] == 6 and result["predicted_frames"] == 15 and not row["row"] and not row["variant"]
    return PAPER.get(result["env"], {}).get(row["method"], "–") if asked else "–"


def _cell(row: Result, name: str) -> str:
    if row[name] is None:
        return "not available"
    digits = 2 if name == "psnr" else 3
    low, high = row[f"{name}_ci95"]
    return f"{row[name]:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def _trainings(result: Result) -> Table:
    body = []
    for job in result["jobs"]:
        if job["status"] != "done":
            body.append([job["name"], job["status"], "–", "–", "–", "–", "–", job["error"] or "–"])
            continue
        tried = ", ".join(f"{trial['rate']:g}: {_trial(trial)}" for trial in job["tried"] or [])
        improving = {True: "still rising", False: "no longer rising", None: "one validation"}[job["still_improving"]]
        ended = "–" if job["validation_psnr"] is None else f"{job['validation_psnr']:.2f} dB, {improving}"
        body.append(
            [
                job["name"],
                f"{job['parameters']:,}",
                f"{job['steps']:,}",
                format_seconds(job["train_seconds"]),
                format_seconds(job["train_seconds"] + (result["slots_seconds"] if job["on_slots"] else 0.0)),
                f"{job['rate']:g}{', at the edge of those tried' if job['at_edge'] else ''}",
                tried or "–",
                ended,
            ]
        )
    headers = ["training", "parameters", "steps", "time", "with SAVi's", "learning rate, factor", "tried", "validation"]
    return Table(headers, body)


def _trial(trial: Result) -> str:
    return f"failed, {trial['error']}" if trial["psnr"] is None else f"{trial['psnr']:.2f} dB"


def _notes(result: Result) -> list[str]:
    notes = [
        (
            "The last seed frame repeated is what every model has to exceed; SAVi's reconstruction of the true frames "
            "is what no model on its slots can."
        ),
        "Latents of another clip: what a model loses by them is what its control brings.",
        "LPIPS: available." if result["lpips"] == "available" else f"LPIPS: not available, {result['lpips']}.",
    ]
    if any(row["method"] and _papers(result, row) != "–" for row in result["summary"]):
        notes.append(
            "The paper's numbers are of larger models, of another rendering of the task and of trainings of days on a "
            "GPU; ours are of the preset, the videos and the steps above."
        )
    if result["slots_of"] and not result["test_recorded"]:
        notes.append(
            f"The slots are those of {result['slots_of']}, trained elsewhere; where its videos were these, it may have "
            "seen the episodes that are tested. The rows of the models on frames have not."
        )
    if "caddy" in result["methods"]:
        notes.append(
            f"CADDY's perceptual loss: {'on' if result['perceptual'] else 'off, there were no VGG19 weights'}."
        )
    notes += [*origin_notes(result["jobs"]), *open_jobs_notes(result["jobs"], "trainings")]
    return [*notes, f"{machine_note(result)}; {format_seconds(result['seconds'])} in all."]


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
