"""What the jobs of a comparison of videos share: clips of episodes that no training saw, the SAVi of methods on slots,
and rows without training."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from playslot_rl.collectors import collect
from playslot_rl.collectors.collection import collect_demos, collect_videos
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compare_video import method_of
from playslot_rl.data.clips import Clips
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.videos import open_videos, place, places
from playslot_rl.data.views import IntArray, split_tested
from playslot_rl.data.weighted import open_configured
from playslot_rl.data.windows import spread_windows
from playslot_rl.envs import PROCEDURAL
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.evaluation.video import open_lpips
from playslot_rl.methods.training import check_method
from playslot_rl.methods.video.predictor import LastFrame, Reconstruction
from playslot_rl.methods.video.scores import as_function, score_clips
from playslot_rl.runs import Run
from playslot_rl.runtime.devices import open_device
from playslot_rl.storage.atomic import json_or_nothing, write_json
from playslot_rl.storage.checkpoints import require_config
from playslot_rl.studies.launch import train
from playslot_rl.studies.video.jobs import uses_slots


def test_sets(config: ExperimentConfig) -> dict[str, str]:
    """The data sets whose clips are tested, by folder name (a ConfigError for two of one name); one of them, or
    episodes kept of `data.root`, has none.
    """
    roots = [part.strip() for part in config.compare_video.test.split(",") if part.strip()]
    if len(roots) <= 1:
        return {"": "".join(roots)}
    named = {Path(root).name: root for root in roots}
    if len(named) < len(roots):
        raise ConfigError(
            f"compare_video.test={config.compare_video.test}: got folders of one name, expected one each: tables are "
            "named by it"
        )
    return named


class Tested(NamedTuple):
    """Clips that are predicted from `shown` seed frames on: the `label` of their test set (empty where it is the only
    one), its episodes, and rows of each clip's frames, int64 (clips, shown + predicted).
    """

    label: str
    shown: int
    source: EpisodeFrames
    rows: IntArray

    @property
    def fingerprint(self) -> str:
        return hashlib.sha256(self.source.frames[self.rows].tobytes()).hexdigest()[:16]

    @property
    def episodes(self) -> IntArray:
        """Number of the recorded episode of each clip (clips,)."""
        begins, source = self.rows[:, :1], self.source
        inside = (source.starts <= begins) & (begins < source.starts + source.lengths)
        numbers: IntArray = source.numbers[inside.argmax(axis=1)]
        return numbers

    def truth(self, clips: int) -> npt.NDArray[np.uint8]:
        """Frames of the first clips, uint8 (clips, P, H, W, 3)."""
        frames: npt.NDArray[np.uint8] = self.source.frames[self.rows[:clips, self.shown :]]
        return frames


def tested_clips(config: ExperimentConfig) -> Iterator[Tested]:
    """The clips of each test set after each number of seed frames; raises as `open_clips`."""
    own = config.compare_video
    for label, test in test_sets(config).items():
        for shown in own.shown:
            yield Tested(label, shown, *open_clips(config, test, shown + own.predicted, own.clips))


def sheet_name(label: str, shown: int) -> str:
    """Name of the frames of a test set (empty where it is the only one) after some seed frames."""
    return f"frames_{label}_{shown}" if label else f"frames_{shown}"


def open_clips(config: ExperimentConfig, test: str, frames: int, count: int) -> tuple[EpisodeFrames, IntArray]:
    """The episodes of a test set (empty: those that are kept of `data.root`), and row numbers (at most `count`, T) of
    clips of T = `frames`, which do not overlap and are spread evenly over the episodes. A DataError for too few
    episodes, none so long, fewer than two clips, or a data set that cannot be read.
    """
    data = config.data
    place, cure = ("compare_video.test", "") if test else ("data.root", ", or raise compare_video.tested")
    try:
        source = open_configured(config, test or data.root)
        tested = source if test else split_tested(source, data.tested)[1]
        rows = spread_windows(tested.starts, tested.lengths, frames, count, range(tested.episodes))
    except DataError as error:
        raise DataError(f"{place}, for clips of compare_video.shown and predicted frames: {error}") from None
    if len(rows) < 2:
        raise DataError(
            f"{place}={test or data.root}: got {len(rows)} held-out clip of {frames} frames, expected at least 2: "
            f"collect more episodes{cure}"
        )
    return tested, rows


LAST_FRAME = "last seed frame, repeated"
RECONSTRUCTION = "SAVi's reconstruction of the true frames"
TEST_SEED = 1_000_003
"""Of a recorded test set: no collection of a preset has it, so that no shipped model has seen its episodes."""


def check_models(config: ExperimentConfig) -> None:
    """Refuse models that do not fit the frames, before anything is computed: a ConfigError or CheckpointError where
    SAVi was trained on frames of another size, SVG-LP or CADDY cannot take these, or the weights of a perceptual loss
    cannot be read.
    """
    for method in config.compare_video.methods:
        if not method_of(method).slots:
            check_method(config, method)
    if config.run and uses_slots(config):
        require_config(Run.open(config.run).stage("slots"), {"env": {"image_size": config.env.image_size}})


def check_clips(config: ExperimentConfig) -> None:
    """Refuse data without enough clips (DataError), and tests on what is trained on (ConfigError), before anything long
    is computed.
    """
    own = config.compare_video
    trained = open_videos(config, config.data.root, "compare-video", False)
    for tested in tested_clips(config):
        test = test_sets(config)[tested.label]
        if test and (place(test) in places(config.data.root) or tested.source.fingerprint == trained.fingerprint):
            raise ConfigError(
                f"compare_video.test={test}: got videos of data.root, which models are trained on, expected others: "
                "leave it out to keep a tenth of data.root's episodes"
            )
    Clips(trained, own.trained_seed + own.trained_frames, config.data.validation, config.seed)


def prepare_videos(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the data sets of training and test, which are recorded where none were named."""
    own, out = config.compare_video, Path(config.out)
    if config.data.root:
        return config
    data = collect_demos(config, out) if config.collect.learn_from_demos else config.data
    config = replace(config, data=collect_videos(replace(config, data=data), out))
    config = replace(config, data=replace(config.data, demos="", held_out=0))
    if own.test:
        return config
    policies = ("random",) if config.env.name in PROCEDURAL else own.tested_on  # there it has no expert
    tests = {policy: out / "data" / "test" / policy for policy in policies}
    for policy, test in tests.items():
        steps = config.collect.expert_steps if policy == "expert" else config.collect.random_steps
        collect(config, policy, own.episodes, steps, test, TEST_SEED, config.workers)
    return replace(config, compare_video=replace(own, test=",".join(map(str, tests.values()))))


def prepare_slots(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the run of the SAVi that methods on slots share, which is trained where none was named."""
    if config.run or not uses_slots(config):
        return config
    model = str(Path(config.out) / "world_model")
    train("train-slots", replace(config, out=model, run=""))
    return replace(config, run=model)


def slots_seconds(config: ExperimentConfig) -> float:
    """Seconds that the SAVi of the models on slots was trained for; 0 without one."""
    return float(Run.open(config.run).stage("slots").meta.get("seconds", 0.0)) if uses_slots(config) else 0.0


def parent_prints(config: ExperimentConfig) -> dict[str, str]:
    """Fingerprints of the videos, the tests and the SAVi that all trainings have in common."""
    parents = {"videos": open_videos(config, config.data.root, "compare-video", False).fingerprint}
    for label, test in test_sets(config).items():
        parents[f"test {label}".strip()] = open_clips(config, test, 2, 2)[0].fingerprint
    if uses_slots(config):
        parents["slots"] = Run.open(config.run).stage("slots").fingerprint
    return parents


def score_references(config: ExperimentConfig, parents: dict[str, str]) -> list[dict[str, Any]]:
    """Scores of the rows that need no training; read, where they were scored on the same clips."""
    own, path = config.compare_video, Path(config.out) / "references.json"
    network = open_lpips(config.metrics.lpips_weights).network
    asked = [own.shown, own.predicted, own.clips, own.tested, list(test_sets(config)), network is not None]
    content = repr([asked, to_dict(config.env), sorted(parents.items())])
    print_ = hashlib.sha256(content.encode()).hexdigest()[:16]
    stored = json_or_nothing(path)
    rows: list[dict[str, Any]] = stored.get("rows", [])
    if stored.get("fingerprint") == print_:
        return rows
    device = open_device(config.device, config.threads)
    models: dict[str, tuple[str, Any]] = {LAST_FRAME: ("nothing", LastFrame())}
    if "slots" in parents:
        models[RECONSTRUCTION] = ("the frames themselves", Reconstruction(Run.open(config.run).load_savi(device)))
    rows, clips = [], []
    for tested in tested_clips(config):
        label, shown, source, at = tested
        clips.append(tested.fingerprint)
        for title, (sees, model) in models.items():
            scores, _ = score_clips(as_function(model, shown), source, at, shown, device, lpips=network)
            rows.append({"title": title, "row": "", "sees": sees, "clips_of": label, "seed_frames": shown, **scores})
    write_json(path, {"fingerprint": print_, "clips": clips, "rows": rows})
    return rows
