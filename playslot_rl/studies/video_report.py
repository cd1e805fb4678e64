"""What came out of a video comparison: `video.json`, `video.md`, `video.png`, `.svg` and the picture sheets.

Shapes: C clips, S seed frames, P predicted frames, H W image height and width.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import ExperimentConfig
from playslot_rl.evaluation.success import hardware
from playslot_rl.methods.video.scores import bootstrap
from playslot_rl.storage.atomic import write_bytes, write_json, write_text
from playslot_rl.storage.checkpoints import provenance
from playslot_rl.studies.launch import Status, read_status
from playslot_rl.studies.report import count_parameters, read_json
from playslot_rl.studies.video_clips import sheet_name, test_sets
from playslot_rl.studies.video_page import video_figure, video_page, video_sheet
from playslot_rl.studies.video_plan import VideoJob
from playslot_rl.visualization.charts import LIGHT, figure_bytes
from playslot_rl.visualization.grid import png

METRICS = ("psnr", "ssim", "lpips")
KIND = ("row", "sees", "clips_of", "seed_frames")
"""What tells the scores of one training apart."""
FALLING = 0.05
"""Gain in dB between the last two validations above which a training was not done."""


def job_summary(job: VideoJob, fingerprint: str) -> dict[str, Any]:
    """One training: `name`, `method`, `title`, `seed`, `status`, `error`, `parameters`, `steps`, `train_seconds`,
    `rate` and `tried` (learning rates), `perceptual` (CADDY's loss had that term), `validation_psnr`,
    `still_improving`; null where there is nothing to say.

    Args:
        job: which one.
        fingerprint: of the job as it is asked for now; one that ended as another is `waiting`.
    """
    status = read_status(job.file)
    if status.fingerprint != fingerprint:
        status = Status()
    done = read_json(job.scores) if status.status == "done" else {}
    curve = [row["psnr"] for row in done.get("validation", [])]
    return {
        "name": job.name,
        "method": job.method,
        "title": job.title,
        "variant": job.variant,
        "seed": job.seed,
        "status": status.status,
        "error": status.error or None,
        "parameters": count_parameters(job.run, job.stage) if done else None,
        "steps": done.get("steps"),
        "train_seconds": done.get("train_seconds"),
        "rate": done.get("choice", {}).get("rate"),
        "tried": done.get("choice", {}).get("tried"),
        "perceptual": done.get("perceptual"),
        "validation_psnr": curve[-1] if curve else None,
        "still_improving": curve[-1] - curve[-2] > FALLING if len(curve) > 1 else None,
        "scores": done.get("scores", []),
    }


def summarise_video(jobs: Sequence[Mapping[str, Any]], references: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row a method, kind of row, test set and number of seed frames: means over training seeds and clips.

    Keys: `method` (null for references), `title`, `variant`, `row`, `sees`, `clips_of`, `seed_frames`, `seeds`,
    `clips`, and for each of `psnr`, `ssim` and `lpips` its mean, `NAME_ci95` (bootstrap over clips, of each clip's mean
    over the seeds and steps), and `NAME_steps` with `NAME_steps_ci95` (P); null where it was not measured.
    """
    groups: dict[tuple[Any, ...], list[tuple[int | None, Mapping[str, Any]]]] = {}
    for job in jobs:
        for score in job["scores"]:
            key = (job["method"], job["title"], job["variant"], *(score[name] for name in KIND))
            groups.setdefault(key, []).append((job["seed"], score))
    for score in references:
        key = (None, score["title"], "", *(score[name] for name in KIND))
        groups.setdefault(key, []).append((None, score))
    rows = []
    for key, group in groups.items():
        seeds = sorted(seed for seed, _ in group if seed is not None)
        summary = dict(zip(("method", "title", "variant", *KIND), key, strict=True))
        summary |= {"seeds": seeds, "clips": len(group[0][1]["psnr"])}
        for name in METRICS:
            summary |= _of_metric(name, [score[name] for _, score in group])
        rows.append(summary)
    return rows


def _of_metric(name: str, values: Sequence[Any]) -> dict[str, Any]:
    if any(value is None for value in values):
        return dict.fromkeys((name, f"{name}_ci95", f"{name}_steps", f"{name}_steps_ci95"))
    clips = np.asarray(values, np.float64).mean(axis=0)  # (C, P)
    return {
        name: float(clips.mean()),
        f"{name}_ci95": list(bootstrap(clips.mean(axis=1))),
        f"{name}_steps": clips.mean(axis=0).tolist(),
        f"{name}_steps_ci95": [list(bootstrap(step)) for step in clips.T],
    }


class VideoComparison:
    """Gathers rows and writes them, at any time.

    Args:
        config: of the comparison, complete.
        out: its folder.
        jobs: all of them, with what their files say.
        references: scores of the rows that need no training, by number of seed frames.
        truth: frames of the first clips by test set and number of seed frames, uint8 (clips, P, H, W, 3).
        lpips_reason: why LPIPS is not available; empty where it is.
        began: `time.monotonic()` at the start of the command.
    """

    def __init__(
        self,
        config: ExperimentConfig,
        out: Path,
        jobs: Mapping[VideoJob, Mapping[str, Any]],
        references: Sequence[Mapping[str, Any]],
        truth: Mapping[tuple[str, int], npt.NDArray[np.uint8]],
        lpips_reason: str,
        began: float,
    ) -> None:
        self.config, self.out, self.jobs, self.truth = config, out, jobs, truth
        self._references, self._reason, self._began = references, lpips_reason, began
        self._spent = float(read_json(out / "video.json").get("seconds", 0.0))

    def result(self) -> dict[str, Any]:
        """What `video.json` holds."""
        config, own, made = self.config, self.config.compare_video, provenance()
        jobs = [job_summary(job, str(record["fingerprint"])) for job, record in self.jobs.items()]
        return {
            "env": config.env.name,
            "preset": config.preset,
            "data": config.data.root,
            "methods": list(own.methods),
            "seeds": list(own.seeds),
            "tested_on": list(test_sets(config)),
            "seed_frames": list(own.shown),
            "predicted_frames": own.predicted,
            "trained": {"seed_frames": own.trained_seed, "predicted_frames": own.trained_frames},
            "budget_minutes": own.budget_minutes,
            "lpips": self._reason or "available",
            "summary": summarise_video(jobs, self._references),
            "jobs": [{key: value for key, value in job.items() if key != "scores"} for job in jobs],
            "test": own.test,
            "slots_of": "" if config.run == str(self.out / "world_model") else config.run,
            "test_recorded": str(self.out / "data" / "test") in own.test,
            "perceptual": any(job["perceptual"] for job in jobs),
            "seconds": round(self._spent + time.monotonic() - self._began, 1),
            "command": made["command"],
            "commit": made["commit"],
            "version": made["version"],
            "hardware": hardware(),
        }

    def ended(self, job: VideoJob) -> None:
        """Say how a job ended, and write what there is so far."""
        summary = job_summary(job, str(self.jobs[job]["fingerprint"]))
        rates = [
            f"{np.mean(s['psnr']):.2f} dB after {s['seed_frames']}{s['clips_of'] and ' of ' + s['clips_of']}"
            for s in summary["scores"]
            if not s["row"]
        ]
        print(f"{job.name}: {summary['error'] or ', '.join(rates) or summary['status']}", flush=True)
        self.write(pictures=False)

    def write(self, pictures: bool = True) -> list[dict[str, Any]]:
        """Write the result; returns the jobs that are not done.

        Raises:
            OutputError: full disk.
        """
        result = self.result()
        write_json(self.out / "video.json", result)
        write_text(self.out / "video.md", video_page(result))
        if pictures:
            for kind in ("png", "svg"):
                write_bytes(self.out / f"video.{kind}", figure_bytes(video_figure(result, LIGHT), LIGHT, kind))
            for (label, shown), truth in self.truth.items():
                name = sheet_name(label, shown)
                write_bytes(self.out / f"{name}.png", png(video_sheet(truth, self._predictions(name))))
        return [job for job in result["jobs"] if job["status"] != "done"]

    def _predictions(self, name: str) -> dict[str, npt.NDArray[np.uint8]]:
        """Predictions of the first clips by title, of the first training seed that is done."""
        found: dict[str, npt.NDArray[np.uint8]] = {}
        for job in self.jobs:
            if job.title not in found and job.pictures.is_file():
                with np.load(job.pictures) as stored:
                    if name in stored:
                        found[job.title] = stored[name]
        return found

    def table(self) -> str:
        """The tables of `video.md`."""
        return "\n".join(line for line in video_page(self.result()).splitlines() if line.startswith("|"))


def read_references(path: Path, fingerprint: str) -> list[dict[str, Any]] | None:
    """References scored before, if on the same clips."""
    try:
        stored = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    rows: list[dict[str, Any]] = stored.get("rows", [])
    return rows if stored.get("fingerprint") == fingerprint else None
