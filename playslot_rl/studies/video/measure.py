"""Predicted frames as the measure of a study: `playslot compare-video`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.envs import RECORDED
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.lpips import open_lpips
from playslot_rl.studies.launch import Status
from playslot_rl.studies.several import Commands
from playslot_rl.studies.study import Record
from playslot_rl.studies.video.begun import require_begun_alike
from playslot_rl.studies.video.clips import sheet_name, test_sets
from playslot_rl.studies.video.figure import video_figure, video_sheet
from playslot_rl.studies.video.jobs import VideoJob, check_variants, video_config, video_jobs, video_record
from playslot_rl.studies.video.page import video_page
from playslot_rl.studies.video.rows import summarise_video, training_row
from playslot_rl.studies.video.shared import (
    check_clips,
    check_models,
    parent_prints,
    prepare_slots,
    prepare_videos,
    score_references,
    true_frames,
)
from playslot_rl.studies.video.training import VideoTraining
from playslot_rl.visualization.grid import png


class VideoMeasure:
    """See `playslot_rl.studies.study.Measure`.

    Args:
        config: with `out`; `run` names a SAVi, or none.
        commands: by which what jobs share is trained.
    """

    command = "compare-video"
    name = "video"
    unit = "trainings"
    page = staticmethod(video_page)
    figure = staticmethod(video_figure)

    def __init__(self, config: ExperimentConfig, commands: Commands) -> None:
        own = config.compare_video
        data = replace(config.data, tested=own.tested if config.data.root and not own.test else 0.0)
        self.config = replace(config, data=data, demos=None)
        self._commands, self._jobs, self._lpips_reason = commands, list[VideoJob](), ""
        self._references, self._truth = list[dict[str, Any]](), dict[tuple[str, int], npt.NDArray[np.uint8]]()

    @property
    def launcher(self) -> tuple[str, Sequence[str]]:
        return self.config.compare_video.launcher, self.config.compare_video.hydra

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
        self.config = config = prepare_slots(config, self._commands)
        parents, found = parent_prints(config), dict[VideoJob, Record]()
        for job in video_jobs(config, Path(config.out)):
            found[job] = video_record(job, video_config(config, job, config.run), parents, not self._lpips_reason)
        require_begun_alike(found, config.compare_video)
        self._references, self._truth = score_references(config, parents), true_frames(config)
        self._jobs = list(found)
        return found

    @staticmethod
    def run(record: Record, commands: Commands) -> None:
        job = VideoJob(record["method"], int(record["seed"]), Path(record["out"]), record["variant"])
        VideoTraining(job, record, commands).run(from_dict(ExperimentConfig, record["config"]))

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
            "summary": summarise_video(rows, self._references),
            "jobs": [{key: value for key, value in row.items() if key != "scores"} for row in rows],
            "test": own.test,
            "slots_of": "" if config.run == str(out / "world_model") else config.run,
            "test_recorded": str(out / "data" / "test") in own.test,
            "perceptual": any(row["perceptual"] for row in rows),
        }

    def sheets(self) -> Mapping[str, bytes]:
        names = {key: sheet_name(*key) for key in self._truth}
        return {name: png(video_sheet(self._truth[key], _predictions(self._jobs, name))) for key, name in names.items()}


def _predictions(jobs: Sequence[VideoJob], name: str) -> dict[str, npt.NDArray[np.uint8]]:
    """Predictions of the first clips by title, of the first training seed that is done."""
    found: dict[str, npt.NDArray[np.uint8]] = {}
    for job in jobs:
        if job.title not in found and job.pictures.is_file():
            with np.load(job.pictures) as stored:
                if name in stored:
                    found[job.title] = stored[name]
    return found
