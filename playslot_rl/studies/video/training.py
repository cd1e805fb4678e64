"""A job of a comparison of videos: the learning rate that suits a method, its training, scores on held-out clips.

One that was begun with other settings is refused in words of the settings that were typed: a trial and a training know
their steps, learning rates and clips, and would name those.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from playslot_rl.config import ExperimentConfig, plugins, to_dict
from playslot_rl.config.compare_video import CompareVideoConfig, method_of
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import CheckpointError, TrainingError
from playslot_rl.evaluation.video import open_lpips
from playslot_rl.methods.video.scores import method_rows, score_clips
from playslot_rl.runs import Run
from playslot_rl.runtime.devices import open_device
from playslot_rl.storage.atomic import json_or_nothing, write_bytes, write_json
from playslot_rl.storage.checkpoints import StageCheckpoint
from playslot_rl.storage.locks import locked
from playslot_rl.studies.launch import train
from playslot_rl.studies.study import Record
from playslot_rl.studies.video.jobs import (
    TRIAL_SEED,
    VideoJob,
    asked_of,
    in_steps,
    makes_trials,
    training_of,
    with_training,
)
from playslot_rl.studies.video.shared import sheet_name, tested_clips

TRAINED_WITH: Final = ("trained_seed", "trained_frames", "tested")
"""Settings that a trial and a training are made with."""
WIDENED: Final = 2
"""How often the grid of learning rates is widened where the best one is at its edge."""
TRIED_WITH: Final = (*TRAINED_WITH, "trial_steps")
"""And those of a trial alone."""


def require_begun_alike(jobs: Iterable[VideoJob], asked: CompareVideoConfig) -> None:
    """Refuse settings other than those with which a job's training or trials were begun, before anything is computed,
    by a CheckpointError that names the key that was typed.
    """
    wanted = to_dict(asked)
    for job in jobs:
        tried = [job.trial(rate) for rate in asked.rates] if makes_trials(asked) else []
        for folder, names in [*((trial, TRIED_WITH) for trial in tried), (job.run, TRAINED_WITH)]:
            stored = _begun_with(folder)
            for name, got, old in _differences(stored, wanted, names):
                raise _other(name, got, old, folder)


def require_same_choice(
    job: VideoJob, asked: CompareVideoConfig, choice: Mapping[str, Any], before: Mapping[str, Any]
) -> None:
    """Refuse a learning rate or a number of steps that a job's training was not begun with, by a CheckpointError that
    names the key that was typed: `choice` has `rate` and `steps` that the trials lead to now, `before` those they led
    to then (empty for nothing).
    """
    stored = _begun_with(job.run)
    if not before or not stored:
        return
    wanted = to_dict(asked)
    for key, name, unit in (("rate", "rates", "a rate of {:g}"), ("steps", "budget_minutes", "{} steps")):
        if choice[key] != before[key] and stored[name] != wanted[name]:
            got = f"{wanted[name]}, which leads to {unit.format(choice[key])}"
            raise _other(name, got, f"{stored[name]} and {unit.format(before[key])}", job.run)


def _begun_with(folder: Path) -> dict[str, Any]:
    """The comparison's settings in a run's config; empty where there is no run."""
    stored = json_or_nothing(folder / "config.json").get("compare_video")
    return stored if isinstance(stored, dict) else {}


def _differences(
    stored: Mapping[str, Any], wanted: Mapping[str, Any], names: Iterable[str]
) -> Iterator[tuple[str, Any, Any]]:
    """Key, wanted and stored value of settings that differ."""
    for name in names:
        test, old = wanted["test"], stored.get("test", wanted["test"])
        if name == "tested" and (old or test):
            if bool(old) != bool(test):  # then no episodes are kept back for it
                yield "test", test or "nothing", old or "nothing"
        elif stored.get(name, wanted[name]) != wanted[name]:
            yield name, wanted[name], stored[name]


def _other(name: str, got: Any, old: Any, folder: Path) -> CheckpointError:
    key = f"{CompareVideoConfig.group}{name}"
    return CheckpointError(
        f"{key}: got {got}, expected {old}, with which {folder} was begun: set {key} back, use another out=, or delete "
        "that folder"
    )


def beyond(tried: Sequence[Mapping[str, Any]]) -> float | None:
    """The factor of a learning rate that is tried next, a step of the grid past the best one where that is at the edge;
    None where it is not, where none ended, or there is no grid.

    Example:
        >>> beyond([{"rate": 1.0, "psnr": 20.0}, {"rate": 3.0, "psnr": 21.0}])
        9.0
    """
    order = sorted(tried, key=lambda trial: float(trial["rate"]))
    ended = [trial for trial in order if trial["psnr"] is not None]
    if not ended or len(order) < 2:
        return None
    best = max(ended, key=lambda trial: float(trial["psnr"]))
    rates = [float(trial["rate"]) for trial in order]
    if best is order[0]:
        return float(f"{rates[0] ** 2 / rates[1]:.3g}")
    return float(f"{rates[-1] ** 2 / rates[-2]:.3g}") if best is order[-1] else None


class VideoTraining:
    """A job under way: what its file says, as it is trained and scored."""

    def __init__(self, job: VideoJob, record: Record) -> None:
        self._job, self._record, self._asked = job, record, asked_of(record)

    def run(self, config: ExperimentConfig) -> None:
        """Choose, train, score; finished parts are skipped."""
        config = self._chosen(config)
        self._train(config)
        self._score(config)

    def _train(self, config: ExperimentConfig) -> None:
        command = "train-dynamics" if method_of(self._job.method).imagines else "train-baseline"
        train(command, config, int(self._record["processes"]))

    def _chosen(self, config: ExperimentConfig) -> ExperimentConfig:
        """The config with the learning rate that was best after short trials, and the steps that fit the budget.

        The method's job that comes first makes the trials; those of its other seeds wait for them.
        """
        job, path = self._job, self._job.choice
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path.with_suffix(".lock")):
            stored = json.loads(path.read_text()) if path.is_file() else {}
            if stored.get("fingerprint") != self._record["choice"]:
                chosen = self._tried(config)
                require_same_choice(job, self._asked, chosen, stored)
                stored = {"fingerprint": self._record["choice"], **chosen}
                write_json(path, stored)
        own = training_of(config, job.method)
        optim = replace(own.optim, lr=own.optim.lr * float(stored["rate"]))
        return in_steps(with_training(config, job.method, optim=optim), job.method, int(stored["steps"]))

    def _tried(self, config: ExperimentConfig) -> dict[str, Any]:
        """The factor of the learning rate, the steps, and the trials that led to them.

        `budget_minutes` are of the training; SAVi's own time counts, so that models on frames get as much on top.
        """
        asked, steps = self._asked, int(training_of(config, self._job.method).steps)
        if not makes_trials(asked):
            return {"rate": asked.rates[0], "steps": steps, "tried": []}
        small = in_steps(replace(config, seed=TRIAL_SEED), self._job.method, asked.trial_steps)
        tried = [self._trial(small, rate) for rate in asked.rates]
        for _ in range(WIDENED):
            if (further := beyond(tried)) is not None:
                tried.append(self._trial(small, further))
        tried.sort(key=lambda trial: float(trial["rate"]))
        ended = [trial for trial in tried if trial["psnr"] is not None]
        if not ended:
            raise TrainingError(f"compare_video.rates={','.join(map(str, asked.rates))}: {tried[0]['error']}")
        best = max(ended, key=lambda trial: float(trial["psnr"]))
        seconds = min(float(trial["seconds_a_step"]) for trial in ended)
        if asked.budget_minutes and seconds:
            spent = 0.0 if method_of(self._job.method).slots else float(self._record.get("slots_seconds", 0.0))
            steps = max(1, round((60 * asked.budget_minutes + spent) / seconds))
        return {"rate": best["rate"], "steps": steps, "tried": tried}

    def _trial(self, config: ExperimentConfig, rate: float) -> dict[str, Any]:
        """Validation PSNR after a short training with a factor of the learning rate, and what a step takes; both None
        with a rate that the training does not survive, and its `error`."""
        job, own = self._job, training_of(config, self._job.method)
        out, failed = job.trial(rate), {"rate": rate, "psnr": None, "seconds_a_step": None}
        try:
            optim = replace(own.optim, lr=own.optim.lr * rate)
        except ValueError as error:  # beyond the bounds of a rate
            return failed | {"error": str(error)}
        steps = {"checkpoint_every": own.steps, "validate_every": own.steps}
        try:
            self._train(replace(with_training(config, job.method, optim=optim, **steps), out=str(out)))
        except TrainingError as error:
            return failed | {"error": str(error)}
        done = Run(out).own(job.stage)
        return {
            "rate": rate,
            "psnr": float(done.meta["metrics"].get("psnr", float("-inf"))),
            "seconds_a_step": float(done.meta["seconds"]) / own.steps,
        }

    def _score(self, config: ExperimentConfig) -> None:
        job, began = self._job, time.monotonic()
        device = open_device(config.device, config.threads)
        run = Run(job.run)
        model, done = plugins.call(METHODS[job.trained_as].load.video, run, device), run.own(job.stage)
        network = open_lpips(config.metrics.lpips_weights).network
        scores, pictures, clips = list[dict[str, Any]](), dict[str, Any](), list[str]()
        for tested in tested_clips(config):
            label, shown, source, rows = tested
            clips.append(tested.fingerprint)
            for row in method_rows(model, shown):
                values, frames = score_clips(
                    row.predict, source, rows, shown, device,
                    lpips=network, shuffled=row.shuffled, shown=self._asked.pictures,
                )  # fmt: skip
                scores.append({"row": row.name, "clips_of": label, "seed_frames": shown, "sees": row.sees, **values})
                if not row.name:
                    pictures[sheet_name(label, shown)] = frames
        packed = io.BytesIO()
        np.savez_compressed(packed, **pictures)
        write_bytes(job.pictures, packed.getvalue())
        facts = {"fingerprint": self._record["fingerprint"], "clips": clips, "scores": scores}
        write_json(job.scores, facts | _of_training(job, done, time.monotonic() - began))


def _of_training(job: VideoJob, done: StageCheckpoint, score_seconds: float) -> dict[str, Any]:
    """What the result says of the training; `validation` is PSNR on validation clips over its steps."""
    path = job.run / job.stage / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    validated = [row for row in rows if row.get("split") == "validation" and "psnr" in row]
    return {
        "metrics": done.meta["metrics"],
        "validation": [{"step": row["step"], "psnr": row["psnr"]} for row in validated],
        "steps": done.meta["steps"],
        "train_seconds": done.meta["seconds"],
        "score_seconds": round(score_seconds, 1),
        "choice": json_or_nothing(job.choice),
        "perceptual": done.meta.get("perceptual"),
        "made": {key: done.meta.get(key, "") for key in ("commit", "processor")},
    }
