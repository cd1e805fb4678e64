"""Predicted frames as the measure of a study: `playslot compare-video`.

Shapes: C clips, P predicted frames.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.config.compare_video import method_of
from playslot_rl.data.views import IntArray
from playslot_rl.envs import RECORDED
from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.evaluation.intervals import hierarchical
from playslot_rl.evaluation.video import open_lpips
from playslot_rl.frames import png
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing, write_json, write_text
from playslot_rl.studies.launch import Status, read_status
from playslot_rl.studies.study import Evaluate, Record, count_parameters, made_by, run_study
from playslot_rl.studies.video.jobs import VideoJob, check_variants, video_config, video_jobs, video_record
from playslot_rl.studies.video.page import objects_page, video_figure, video_page, video_sheet
from playslot_rl.studies.video.shared import (
    check_clips,
    check_models,
    parent_prints,
    prepare_slots,
    prepare_videos,
    score_references,
    sheet_name,
    slots_seconds,
    test_sets,
    tested_clips,
)
from playslot_rl.studies.video.training import VideoTraining, beyond, require_begun_alike
from playslot_rl.visualization.document import to_markdown

METRICS = ("psnr", "ssim", "lpips")
KIND = ("row", "sees", "clips_of", "seed_frames")
"""What tells the scores of one training apart."""
FALLING = 0.05
"""Gain in dB between the last two validations above which a training was not done."""


def training_row(job: VideoJob, status: Status) -> dict[str, Any]:
    """One training; null where there is nothing to say.

    Of its keys, `rate` and `tried` are factors of the learning rate, `at_edge` says that the best one is the smallest
    or the largest, `perceptual` that CADDY's loss had that term, and `scores` are clip by clip.
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
        "at_edge": beyond(done.get("choice", {}).get("tried") or []) is not None,
        "on_slots": method_of(job.method).slots,
        **made_by(done.get("made", {}), status),
        "perceptual": done.get("perceptual"),
        "validation_psnr": curve[-1] if curve else None,
        "still_improving": curve[-1] - curve[-2] > FALLING if len(curve) > 1 else None,
        "scores": done.get("scores", []),
    }


def summarise_video(
    jobs: Sequence[Mapping[str, Any]],
    references: Sequence[Mapping[str, Any]],
    episodes: Mapping[tuple[str, int], IntArray],
) -> list[dict[str, Any]]:
    """One row a method, kind of row, test set and number of seed frames: means over training seeds and clips, whose
    episodes (C,) are given by test set and number of seed frames; clips of one are no more than one to an interval.

    Keys: `method` (null for references), `title`, `variant`, `row`, `sees`, `clips_of`, `seed_frames`, `seeds`,
    `clips`, `episodes`, and for each of `psnr`, `ssim` and `lpips` its mean, `NAME_ci95` (bootstrap over training seeds
    and episodes), and `NAME_steps` with `NAME_steps_ci95` (P); null where it was not measured.
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
        of_clips = episodes[summary["clips_of"], summary["seed_frames"]]
        summary |= {"seeds": seeds, "clips": len(of_clips), "episodes": len(np.unique(of_clips))}
        for name in METRICS:
            summary |= _of_metric(name, [score[name] for _, score in group], of_clips)
        rows.append(summary)
    return rows


def _of_metric(name: str, values: Sequence[Any], episodes: IntArray) -> dict[str, Any]:
    if any(value is None for value in values):
        return dict.fromkeys((name, f"{name}_ci95", f"{name}_steps", f"{name}_steps_ci95"))
    scores = np.asarray(values, np.float64)[None]  # (1, seeds, C, P)
    numbers, clips = np.unique(episodes, return_counts=True)
    of_each = np.stack([scores[:, :, episodes == number].mean(axis=2) for number in numbers], axis=2)
    return {
        name: float(scores.mean()),
        f"{name}_ci95": list(hierarchical(of_each.mean(axis=3), weights=clips)),
        f"{name}_steps": scores.mean(axis=(0, 1, 2)).tolist(),
        f"{name}_steps_ci95": [list(hierarchical(step, weights=clips)) for step in np.moveaxis(of_each, 3, 0)],
    }


class VideoMeasure:
    """See `playslot_rl.studies.study.Measure`; the config has `out`, and `run` names a SAVi, or none."""

    command = "compare-video"
    name = "video"
    unit = "trainings"
    page = staticmethod(video_page)
    figure = staticmethod(video_figure)

    def __init__(self, config: ExperimentConfig) -> None:
        own = config.compare_video
        tested = own.tested if config.data.root and not own.test else 0.0
        held_out = 0 if tested else config.data.held_out  # the trainings hold out none
        data = replace(config.data, held_out=held_out, tested=tested)
        self.config = replace(config, data=data, demos=None)
        self.launcher: tuple[str, Sequence[str]] = (own.launcher, own.hydra)
        self._jobs, self._lpips_reason = dict[VideoJob, Record](), ""
        self._references, self._truth = list[dict[str, Any]](), dict[tuple[str, int], npt.NDArray[np.uint8]]()
        self._episodes = dict[tuple[str, int], IntArray]()

    def check(self) -> None:
        config = self.config
        check_variants(config)
        check_models(config)
        self._lpips_reason = open_lpips(config.metrics.lpips_weights).reason  # a wrong file is refused
        if config.data.root:
            check_clips(config)
        elif config.env.name in RECORDED:
            raise ConfigError(
                f"data.root: got nothing with env={config.env.name}, which nothing records, expected a data set of "
                "videos"
            )

    def prepare(self) -> Mapping[VideoJob, Record]:
        config = prepare_videos(self.config)
        if config is not self.config:  # those just recorded are looked at before SAVi is trained
            check_clips(config)
        self.config = config = prepare_slots(config)
        parents, found = parent_prints(config), dict[VideoJob, Record]()
        for job in video_jobs(config, Path(config.out)):
            own = video_config(config, job, config.run)
            found[job] = video_record(job, own, parents, not self._lpips_reason, slots_seconds(config))
        require_begun_alike(found, config.compare_video)
        self._references = score_references(config, parents)
        for tested in tested_clips(config):
            key = tested.label, tested.shown
            self._truth[key], self._episodes[key] = tested.truth(config.compare_video.pictures), tested.episodes
        self._jobs = found
        return found

    @staticmethod
    def run(record: Record, evaluate: Evaluate) -> None:  # noqa: ARG004
        VideoTraining(_job(record), record).run(from_dict(ExperimentConfig, record["config"]))

    @staticmethod
    def agrees(record: Record) -> bool:
        job = _job(record)
        return bool(json_or_nothing(job.scores).get("fingerprint") == record["fingerprint"])

    def rows(self, job: VideoJob, status: Status) -> list[dict[str, Any]]:
        return [training_row(job, status)]

    def said(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return ", ".join(
            f"{np.mean(score['psnr']):.2f} dB after {score['seed_frames']}"
            f"{score['clips_of'] and ' of ' + score['clips_of']}"
            for row in rows
            for score in row["scores"]
            if not score["row"]
        )

    def result(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        config, own, out = self.config, self.config.compare_video, Path(self.config.out)
        return {
            "data": config.data.root,
            "methods": list(own.methods),
            "seeds": list(own.seeds),
            "tested_on": list(test_sets(config)),
            "seed_frames": list(own.shown),
            "predicted_frames": own.predicted,
            "trained": {"seed_frames": own.trained_seed, "predicted_frames": own.trained_frames},
            "budget_minutes": own.budget_minutes,
            "lpips": self._lpips_reason or "available",
            "summary": summarise_video(rows, self._references, self._episodes),
            "jobs": [{key: value for key, value in row.items() if key != "scores"} for row in rows],
            "test": own.test,
            "slots_seconds": slots_seconds(config),
            "slots_of": "" if config.run == str(out / "world_model") else config.run,
            "test_recorded": str(out / "data" / "test") in own.test,
            "perceptual": any(row["perceptual"] for row in rows),
        }

    def sheets(self) -> Mapping[str, bytes]:
        names = {key: sheet_name(*key) for key in self._truth}
        return {name: png(video_sheet(self._truth[key], _predictions(self._jobs, name))) for key, name in names.items()}


def _job(record: Record) -> VideoJob:
    return VideoJob(record["method"], int(record["seed"]), Path(record["out"]), record["variant"])


def _predictions(jobs: Mapping[VideoJob, Record], name: str) -> dict[str, npt.NDArray[np.uint8]]:
    """Predictions of the first clips by title, of the first training seed that is done as its file asks."""
    found: dict[str, npt.NDArray[np.uint8]] = {}
    for job, record in jobs.items():
        done = read_status(job.file, record["fingerprint"]).status == "done"
        if done and job.title not in found and job.pictures.is_file():
            with np.load(job.pictures) as stored:
                if name in stored:
                    found[job.title] = stored[name]
    return found


def each_number(config: ExperimentConfig) -> None:
    """Run the study for each of `compare_video.objects`, and write `OUT/video.json` and `OUT/video.md`. A ConfigError
    for another task, or videos that have their number of objects already; a PlaySlotError where trainings failed: all
    others have finished, and the tables say so.

    With N objects a frame has N + 1 slots, and an action two numbers for each object.
    """
    own, out, failed = config.compare_video, Path(config.out), list[str]()
    if config.env.name != "grid_shapes" or config.data.root or own.test or config.run:
        raise ConfigError(
            "objects: got a task or videos with a number of objects of their own, expected env=grid_shapes without "
            "data.root=, compare_video.test= and run="
        )
    found = {}
    for number in own.objects:
        part = out / f"objects_{number}"
        try:
            run_study(VideoMeasure(_with_objects(config, number, part)))
        except PlaySlotError as error:
            if not (part / "video.json").is_file():
                raise
            failed.append(str(error))
        found[str(number)] = json.loads((part / "video.json").read_text())
        write_json(out / "video.json", {"objects": found})
        write_text(out / "video.md", to_markdown(objects_page(found)))
    print(f"compare-video: {out / 'video.md'}", flush=True)
    if failed:
        raise PlaySlotError("; ".join(failed))


def _with_objects(config: ExperimentConfig, number: int, out: Path) -> ExperimentConfig:
    grid = replace(config.env.grid, objects=number)
    savi = replace(config.model.savi, n_slots=number + 1)
    return replace(
        config,
        env=replace(config.env, grid=grid, action_dim=2 * number),
        model=replace(config.model, savi=savi),
        compare_video=replace(config.compare_video, objects=()),
        out=str(out),
    )
