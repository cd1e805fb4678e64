"""The grid of learning rates is widened where the best one is at its edge, and SAVi's time counts."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import compose
from playslot_rl.evaluation.intervals import hierarchical
from playslot_rl.studies.launch import Status, write_status
from playslot_rl.studies.video import shared
from playslot_rl.studies.video.jobs import VideoJob, video_record
from playslot_rl.studies.video.measure import _predictions, summarise_video
from playslot_rl.studies.video.training import VideoTraining, beyond


def trials(psnr_at: dict[float, float | None]) -> list[dict[str, Any]]:
    return [{"rate": rate, "psnr": psnr} for rate, psnr in psnr_at.items()]


@pytest.mark.parametrize(
    ("tried", "expected"),
    [
        ({0.3: 20.0, 1.0: 22.0, 3.0: 21.0}, None),
        ({0.3: 20.0, 1.0: 21.0, 3.0: 22.0}, 9.0),
        ({0.3: 22.0, 1.0: 21.0, 3.0: 20.0}, 0.09),
        ({0.3: 20.0, 1.0: 21.0, 3.0: None}, None),
        ({1.0: 20.0}, None),
        ({0.3: None, 1.0: None, 3.0: None}, None),
    ],
)
def test_the_next_rate_lies_past_a_best_one_at_the_edge(
    tried: dict[float, float | None], expected: float | None
) -> None:
    assert beyond(trials(tried)) == expected


class Tried(VideoTraining):
    """Trials whose PSNR is a function of the rate; a step takes half a second."""

    best = 0.0

    def _trial(self, config: ExperimentConfig, rate: float) -> dict[str, Any]:
        return {"rate": rate, "psnr": -abs(rate - self.best), "seconds_a_step": 0.5}

    def chosen(self, config: ExperimentConfig) -> dict[str, Any]:
        return self._tried(config)


def of(method: str, out: Path, *typed: str, slots_seconds: float = 0.0) -> tuple[Tried, ExperimentConfig]:
    config = compose(
        ["preset=smoke", f"methods={method}", "compare_video.rates=[0.3,1.0,3.0]", *typed], "compare-video"
    )
    job = VideoJob(method, 0, out)
    return Tried(job, video_record(job, config, {}, lpips=False, slots_seconds=slots_seconds)), config


@pytest.mark.parametrize(
    ("best", "rates"), [(1.0, [0.3, 1.0, 3.0]), (9.0, [0.3, 1.0, 3.0, 9.0, 27.0]), (99.0, [0.3, 1.0, 3.0, 9.0, 27.0])]
)
def test_the_grid_is_widened_twice_at_most(best: float, rates: list[float], tmp_path: Path) -> None:
    training, config = of("svg", tmp_path)
    training.best = best
    found = training.chosen(config)
    assert [trial["rate"] for trial in found["tried"]] == rates
    assert (beyond(found["tried"]) is not None) == (best == 99.0), "what is still at the edge can be marked"


def test_models_on_frames_get_savis_time_on_top_of_the_budget(tmp_path: Path) -> None:
    budget = "compare_video.budget_minutes=1"
    steps = {}
    for method in ("svg", "playslot"):
        training, config = of(method, tmp_path, budget, slots_seconds=30.0)
        steps[method] = training.chosen(config)["steps"]
    assert steps == {"svg": 180, "playslot": 120}


def test_pictures_are_of_jobs_that_are_done_as_asked(tmp_path: Path) -> None:
    pictures = np.zeros((1, 2, 4, 4, 3), np.uint8)
    jobs = {VideoJob("svg", seed, tmp_path): {"fingerprint": "new"} for seed in range(4)}
    status = [Status("running", "new"), Status("failed", "new"), Status("done", "old"), Status("done", "new")]
    for number, (job, how) in enumerate(zip(jobs, status, strict=True)):
        write_status(job.file, how)
        job.pictures.parent.mkdir(parents=True)
        if how == status[-1]:
            np.savez_compressed(job.pictures, shown=pictures + number)
        else:  # of a process that was killed while it wrote
            job.pictures.write_bytes(b"PK\x03\x04")
    (found,) = _predictions(jobs, "shown").values()
    assert (found == 3).all()


def test_savis_time_names_no_job(tmp_path: Path) -> None:
    job = VideoJob("svg", 0, tmp_path)
    config = compose(["preset=smoke"], "compare-video")
    records = [video_record(job, config, {}, lpips=False, slots_seconds=seconds) for seconds in (0.0, 30.0)]
    assert records[0]["fingerprint"] == records[1]["fingerprint"]
    assert records[0] == {key: value for key, value in records[1].items() if key != "slots_seconds"}


def test_clips_of_one_episode_are_one_to_an_interval() -> None:
    draws = np.random.default_rng(0)
    of_episodes = draws.normal(20, 1, 6)
    episodes = np.repeat(np.arange(6), 4)
    scores = np.repeat(of_episodes, 4)[:, None] + np.zeros((24, 3))
    kind = {"row": "", "sees": "", "clips_of": "", "seed_frames": 2, "title": "still"}
    given = {**kind, **{name: scores.tolist() for name in ("psnr", "ssim", "lpips")}}
    [found] = summarise_video([], [given], {("", 2): episodes})
    assert (found["clips"], found["episodes"]) == (24, 6)
    assert found["psnr"] == pytest.approx(of_episodes.mean())
    assert found["psnr_ci95"] == pytest.approx(hierarchical(of_episodes[None, None]))
    [apart] = summarise_video([], [given], {("", 2): np.arange(24)})
    wide, narrow = (row["psnr_ci95"][1] - row["psnr_ci95"][0] for row in (found, apart))
    assert wide > 2 * narrow
    [uneven] = summarise_video([], [given], {("", 2): np.minimum(episodes, 4)})
    assert uneven["psnr"] == pytest.approx(of_episodes.mean()), "still the mean over clips"


def test_a_clip_is_of_the_recorded_episode_that_its_frames_are_in() -> None:
    source = SimpleNamespace(starts=np.array([8, 0, 4]), lengths=np.array([4, 4, 4]), numbers=np.array([5, 7, 7]))
    tested = shared.Tested("", 1, source, np.array([[0, 1], [2, 3], [9, 10], [6, 7]]))  # type: ignore[arg-type]
    assert tested.episodes.tolist() == [7, 7, 5, 7], "two views of one recording are one"
