"""One training of a video comparison: the learning rate that suits it, the training, its scores on held-out clips.

Started by `playslot_rl.recipes.compare_job`, which says how it ended.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.errors import TrainingError

if TYPE_CHECKING:
    from playslot_rl.studies.video_plan import VideoJob


def run(record: dict[str, Any]) -> None:
    """Choose, train, score; finished parts are skipped.

    Raises:
        PlaySlotError: whatever the training or its data refuse.
    """
    from playslot_rl.studies.video_plan import VideoJob

    job = VideoJob(record["method"], int(record["seed"]), Path(record["out"]), record["variant"])
    config = _chosen(job, from_dict(ExperimentConfig, record["config"]), record)
    _train(job, config, int(record["processes"]))
    _score(job, config, record)


def _train(job: VideoJob, config: ExperimentConfig, processes: int) -> None:
    from playslot_rl.recipes import train_baseline, train_dynamics
    from playslot_rl.studies.several import train_on_several

    if processes > 1:
        train_on_several("train-dynamics" if job.trained_as == "playslot" else "train-baseline", config, processes)
    elif job.trained_as == "playslot":
        train_dynamics.main(config)
    else:
        train_baseline.main(config)


def _chosen(job: VideoJob, config: ExperimentConfig, record: dict[str, Any]) -> ExperimentConfig:
    """The config with the learning rate that was best after short trials, and the steps that fit the budget.

    The method's job that comes first makes the trials; those of its other seeds wait for them.
    """
    from playslot_rl.storage.atomic import write_json
    from playslot_rl.storage.locks import locked
    from playslot_rl.studies.begun import require_same_choice
    from playslot_rl.studies.video_plan import asked_of, in_steps, training_of, with_training

    path = job.choice
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.with_suffix(".lock")):
        stored = json.loads(path.read_text()) if path.is_file() else {}
        if stored.get("fingerprint") != record["choice"]:
            chosen = _tried(job, config, record)
            require_same_choice(job, asked_of(record), chosen, stored)
            stored = {"fingerprint": record["choice"], **chosen}
            write_json(path, stored)
    own = training_of(config, job.method)
    optim = replace(own.optim, lr=own.optim.lr * float(stored["rate"]))
    return in_steps(with_training(config, job.method, optim=optim), job.method, int(stored["steps"]))


def _tried(job: VideoJob, config: ExperimentConfig, record: dict[str, Any]) -> dict[str, Any]:
    """The factor of the learning rate, the steps, and the trials that led to them."""
    from playslot_rl.studies.video_plan import TRIAL_SEED, asked_of, makes_trials, training_of

    asked, steps = asked_of(record), int(training_of(config, job.method).steps)
    if not makes_trials(asked):
        return {"rate": asked.rates[0], "steps": steps, "tried": []}
    config, processes = replace(config, seed=TRIAL_SEED), int(record["processes"])
    tried = [_trial(job, config, rate, asked.trial_steps, processes) for rate in asked.rates]
    ended = [trial for trial in tried if trial["psnr"] is not None]
    if not ended:
        raise TrainingError(f"compare_video.rates={','.join(map(str, asked.rates))}: {tried[0]['error']}")
    best = max(ended, key=lambda trial: float(trial["psnr"]))
    seconds = min(float(trial["seconds_a_step"]) for trial in ended)
    if asked.budget_minutes and seconds:
        steps = max(1, round(60 * asked.budget_minutes / seconds))
    return {"rate": best["rate"], "steps": steps, "tried": tried}


def _trial(job: VideoJob, config: ExperimentConfig, rate: float, steps: int, processes: int) -> dict[str, Any]:
    """Validation PSNR after a short training with a factor of the learning rate, and what a step takes; both None with
    a rate that the training does not survive, and its `error`."""
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.studies.video_plan import in_steps, training_of, with_training

    config = in_steps(config, job.method, steps)
    own = training_of(config, job.method)
    out, failed = job.trial(rate), {"rate": rate, "psnr": None, "seconds_a_step": None}
    changes: dict[str, Any] = {"checkpoint_every": steps, "validate_every": steps}
    try:
        changes["optim"] = replace(own.optim, lr=own.optim.lr * rate)
    except ValueError as error:  # beyond the bounds of a rate
        return failed | {"error": str(error)}
    try:
        _train(job, replace(with_training(config, job.method, **changes), out=str(out)), processes)
    except TrainingError as error:
        return failed | {"error": str(error)}
    done = read_stage(checkpoint_folder(out, job.stage), job.stage)
    return {
        "rate": rate,
        "psnr": float(done.meta["metrics"].get("psnr", float("-inf"))),
        "seconds_a_step": float(done.meta["seconds"]) / steps,
    }


def _score(job: VideoJob, config: ExperimentConfig, record: dict[str, Any]) -> None:
    """Write `RUN/video.json` and the predictions of the first clips."""
    import numpy as np

    from playslot_rl.evaluation.lpips import open_lpips
    from playslot_rl.methods.video.load import load_video
    from playslot_rl.methods.video.rows import method_rows
    from playslot_rl.methods.video.scores import score_clips
    from playslot_rl.recipes.run import open_device
    from playslot_rl.storage.atomic import explain_write_errors, write_json
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.studies.video_clips import sheet_name, tested_clips
    from playslot_rl.studies.video_plan import asked_of

    asked, device, began = asked_of(record), open_device(config), time.monotonic()
    model = load_video(job.trained_as, job.run, device)
    done = read_stage(checkpoint_folder(job.run, job.stage), job.stage)
    network = open_lpips(config.metrics.lpips_weights).network
    scores, pictures = [], dict[str, Any]()
    clips = []
    for tested in tested_clips(config):
        label, shown, source, rows = tested
        clips.append(tested.fingerprint)
        for row in method_rows(model, shown):
            values, frames = score_clips(
                row.predict, source, rows, shown, device, lpips=network, shuffled=row.shuffled, shown=asked.pictures
            )
            scores.append({"row": row.name, "clips_of": label, "seed_frames": shown, "sees": row.sees, **values})
            if not row.name:
                pictures[sheet_name(label, shown)] = frames
    with explain_write_errors(job.pictures):
        np.savez_compressed(job.pictures, **pictures)
    write_json(
        job.scores,
        {
            "fingerprint": record["fingerprint"],
            "clips": clips,
            "scores": scores,
            "metrics": done.meta["metrics"],
            "validation": _validations(job),
            "steps": done.meta["steps"],
            "train_seconds": done.meta["seconds"],
            "score_seconds": round(time.monotonic() - began, 1),
            "choice": json.loads(job.choice.read_text()),
            "perceptual": done.meta.get("perceptual"),
        },
    )


def _validations(job: VideoJob) -> list[dict[str, float]]:
    """PSNR on validation clips over the steps of the training."""
    path = job.run / job.stage / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    return [{"step": r["step"], "psnr": r["psnr"]} for r in rows if r.get("split") == "validation" and "psnr" in r]
