"""What came out of a comparison of videos: one row a training, and its scores over training seeds and clips.

Shapes: C clips, P predicted frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from playslot_rl.methods.video.scores import bootstrap
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.studies.job import count_parameters
from playslot_rl.studies.launch import Status
from playslot_rl.studies.video.jobs import VideoJob

METRICS = ("psnr", "ssim", "lpips")
KIND = ("row", "sees", "clips_of", "seed_frames")
"""What tells the scores of one training apart."""
FALLING = 0.05
"""Gain in dB between the last two validations above which a training was not done."""


def training_row(job: VideoJob, status: Status) -> dict[str, Any]:
    """One training; null where there is nothing to say.

    Of its keys, `rate` and `tried` are factors of the learning rate, `perceptual` says that CADDY's loss had that term,
    and `scores` are clip by clip.
    """
    done = json_or_nothing(job.scores) if status.status == "done" else {}
    curve = [row["psnr"] for row in done.get("validation", [])]
    return {
        "name": job.name,
        "method": job.method,
        "title": job.title,
        "variant": job.variant,
        "seed": job.seed,
        "status": status.status,
        "error": status.error or None,
        "parameters": count_parameters(Run(job.run), job.stage) if done else None,
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
