"""`playslot compare-video methods=M,... seeds=S,... out=DIR`: predictors side by side (docs/how-to/compare.md)."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError, PlaySlotError
from playslot_rl.recipes.run import parent_run

TEST_SEED = 1_000_003
"""Of a recorded test set: no collection of a preset has it, so that no shipped model has seen its episodes."""

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def main(config: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/video.json`, `.md`, `.png`, `.svg` and sheets of frames.

    With `objects=` this is done for each number of them, in `OUT/objects_N`, and `OUT` gets the table of all.

    Raises:
        ConfigError, DataError, CheckpointError: what is asked for cannot be compared; before anything is computed.
        PlaySlotError: a job failed; the others have finished, and the table says so.
        KeyboardInterrupt: Ctrl-C; the same command carries on.
    """
    config = replace(config, out=config.out or f"runs/video_{config.env.name}_{config.preset}")
    if config.compare_video.objects:
        from playslot_rl.recipes.compare_video_objects import each_number

        each_number(config, compare)
    else:
        compare(config)


def compare(config: ExperimentConfig) -> None:
    """One comparison, into `config.out`; raises as `main` does."""
    from playslot_rl.envs import RECORDED
    from playslot_rl.evaluation.lpips import open_lpips
    from playslot_rl.studies.begun import require_begun_alike
    from playslot_rl.studies.launch import comparison_lock, open_comparison, run_due
    from playslot_rl.studies.video_plan import check_variants, video_job_config, video_job_record, video_jobs
    from playslot_rl.studies.video_report import VideoComparison

    began, own, out = time.monotonic(), config.compare_video, Path(config.out)
    check_variants(config)
    run = parent_run(config, out) if config.run else ""
    _check_models(config, run)
    data = replace(config.data, tested=own.tested if config.data.root and not own.test else 0.0)
    config = replace(config, run=run, data=data, demos=None)
    lpips = open_lpips(config.metrics.lpips_weights)  # a wrong file is refused before anything is computed
    recorded = bool(config.data.root)
    if recorded:
        _check_clips(config)
    elif config.env.name in RECORDED:
        raise ConfigError(
            f"data.root: got nothing with env={config.env.name}, which nothing records, expected a data set of videos"
        )
    open_comparison(out)
    with comparison_lock(out):
        config = _prepare(config, out)
        if not recorded:
            _check_clips(config)
        parents, jobs = _parents(config), {}
        for job in video_jobs(config, out):
            own_config = video_job_config(config, job, config.run)
            jobs[job] = video_job_record(job, own_config, parents, lpips=lpips.network is not None)
        require_begun_alike(jobs, config.compare_video)
        references, truth = _references(config, out, parents)
        report = VideoComparison(config, out, jobs, references, truth, lpips.reason, began)
        run_due("compare-video", report, own.launcher, own.hydra)
        failed = [job for job in report.write() if job["status"] == "failed"]
    print(report.table(), flush=True)
    print(f"compare-video: {time.monotonic() - began:.0f} s, {out / 'video.md'}", flush=True)
    if failed:
        names = ", ".join(job["name"] for job in failed)
        raise PlaySlotError(
            f"compare-video: {len(failed)} of {len(jobs)} trainings failed ({names}), the others finished; "
            f"{out / 'video.md'} says why, and the same command tries them again"
        )


def _check_models(config: ExperimentConfig, run: str) -> None:
    """Refuse models that do not fit the frames, before anything is computed.

    Raises:
        ConfigError, CheckpointError: SAVi was trained on frames of another size, SVG-LP or CADDY cannot take these, or
            the weights of a perceptual loss cannot be read.
    """
    from playslot_rl.config.compare_video import ON_SLOTS
    from playslot_rl.methods.video.load import check_pixel_model
    from playslot_rl.storage.checkpoints import require_config
    from playslot_rl.studies.video_plan import uses_slots
    from playslot_rl.training.runs import slots_checkpoint

    for method in config.compare_video.methods:
        if method not in ON_SLOTS:
            check_pixel_model(method, config.baselines, config.env.image_size)
    if run and uses_slots(config):
        require_config(slots_checkpoint(run), {"env": {"image_size": config.env.image_size}})


def _check_clips(config: ExperimentConfig) -> None:
    """Refuse data without enough clips, and tests on what is trained on, before anything long is computed.

    Raises:
        ConfigError: a test set is one of the sets that are trained on.
        DataError: too few episodes, or none as long as a clip of training or test.
    """
    from playslot_rl.config.weights import data_roots
    from playslot_rl.data.windows import Clips
    from playslot_rl.studies.video_clips import test_sets, tested_clips
    from playslot_rl.training.record import open_videos

    own = config.compare_video
    trained = open_videos(config, config.data.root, "compare-video")
    folders = {Path(root.path).resolve() for root in data_roots(config.data.root)}
    for tested in tested_clips(config):
        test = test_sets(config)[tested.label]
        if test and (Path(test).resolve() in folders or tested.source.fingerprint == trained.fingerprint):
            raise ConfigError(
                f"compare_video.test={test}: got videos of data.root, which models are trained on, expected others: "
                "leave it out to keep a tenth of data.root's episodes"
            )
    Clips(trained, own.trained_seed + own.trained_frames, config.data.validation, config.seed)


def _prepare(config: ExperimentConfig, out: Path) -> ExperimentConfig:
    """Record or find the videos, and train or find the SAVi that methods on slots share.

    Raises:
        DataError, CheckpointError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.collectors import collect
    from playslot_rl.envs import PROCEDURAL
    from playslot_rl.recipes import train_slots
    from playslot_rl.recipes.pipeline import collect_demos, collect_videos
    from playslot_rl.studies.video_plan import uses_slots
    from playslot_rl.training.runs import slots_checkpoint

    own = config.compare_video
    if not config.data.root:
        data = collect_demos(config, out) if config.collect.learn_from_demos else config.data
        config = replace(config, data=collect_videos(replace(config, data=data), out))
        config = replace(config, data=replace(config.data, demos="", held_out=0))
        if not own.test:
            tests = {policy: out / "data" / "test" / policy for policy in own.tested_on}
            if config.env.name in PROCEDURAL:
                tests = {"random": out / "data" / "test" / "random"}  # there is no expert
            for policy, test in tests.items():
                steps = config.collect.expert_steps if policy == "expert" else config.collect.random_steps
                collect(config, policy, own.episodes, steps, test, TEST_SEED, config.workers)
            config = replace(config, compare_video=replace(own, test=",".join(map(str, tests.values()))))
    if uses_slots(config):
        if config.run:
            slots_checkpoint(config.run)
        else:
            model = out / "world_model"
            train_slots.main(replace(config, out=str(model), run=""))
            config = replace(config, run=str(model))
    return config


def _parents(config: ExperimentConfig) -> dict[str, str]:
    from playslot_rl.studies.video_clips import open_clips, test_sets
    from playslot_rl.studies.video_plan import uses_slots
    from playslot_rl.training.record import open_videos
    from playslot_rl.training.runs import slots_checkpoint

    parents = {"videos": open_videos(config, config.data.root, "compare-video").fingerprint}
    for label, test in test_sets(config).items():
        parents[f"test {label}".strip()] = open_clips(config, test, 2, 2)[0].fingerprint
    if uses_slots(config):
        parents["slots"] = slots_checkpoint(config.run).fingerprint
    return parents


def _references(
    config: ExperimentConfig, out: Path, parents: dict[str, str]
) -> tuple[list[dict[str, Any]], dict[tuple[str, int], npt.NDArray[np.uint8]]]:
    """Scores of the rows that need no training, and the true frames of the first clips."""
    from playslot_rl.config import to_dict
    from playslot_rl.evaluation.lpips import open_lpips
    from playslot_rl.methods.video.scores import as_function, score_clips
    from playslot_rl.methods.video.slots import LastFrame, Reconstruction
    from playslot_rl.recipes.run import open_device
    from playslot_rl.storage.atomic import write_json
    from playslot_rl.studies.video_clips import test_sets, tested_clips
    from playslot_rl.studies.video_page import LAST_FRAME, RECONSTRUCTION
    from playslot_rl.studies.video_report import read_references
    from playslot_rl.training.runs import load_savi

    own, device = config.compare_video, open_device(config)
    network = open_lpips(config.metrics.lpips_weights).network
    asked = [own.shown, own.predicted, own.clips, own.tested, list(test_sets(config)), network is not None]
    print_ = hashlib.sha256(repr([asked, to_dict(config.env), sorted(parents.items())]).encode()).hexdigest()[:16]
    models: dict[str, tuple[str, Any]] = {LAST_FRAME: ("nothing", LastFrame())}
    if "slots" in parents:
        models[RECONSTRUCTION] = ("the frames themselves", Reconstruction(load_savi(config.run, device)))
    stored = read_references(out / "references.json", print_)
    rows, truth, clips = stored or [], {}, []
    for tested in tested_clips(config):
        label, shown, source, at = tested
        clips.append(tested.fingerprint)
        truth[label, shown] = source.frames[at[: own.pictures, shown:]]
        for title, (sees, model) in models.items() if stored is None else ():
            scores, _ = score_clips(as_function(model, shown), source, at, shown, device, lpips=network)
            rows.append({"title": title, "row": "", "sees": sees, "clips_of": label, "seed_frames": shown, **scores})
    write_json(out / "references.json", {"fingerprint": print_, "clips": clips, "rows": rows})
    return rows, truth
