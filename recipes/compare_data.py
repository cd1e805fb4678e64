"""What the jobs of a comparison share, made once: demonstrations, videos, the world model, other models of videos."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import DataConfig, ExperimentConfig, from_dict
from playslot_rl.config.methods import METHODS
from playslot_rl.config.weights import data_roots
from playslot_rl.errors import ConfigError

if TYPE_CHECKING:
    from playslot_rl.studies.plan import Job

RECORDED = Path("data") / "expert"


def check_data(config: ExperimentConfig, out: Path) -> ExperimentConfig:
    """The config with the data sets that are known already; refuses those that do not fit, before anything is written.

    Raises:
        ConfigError: too few demonstrations, or an evaluation seed among the training seeds.
        DataError: a data set cannot be read, or the demonstrations have no actions.
    """
    from playslot_rl.evaluation.seeds import check_disjoint, first_seed, training_seeds

    config = replace(config, data=_known(config), method="playslot", demos=None)
    _check_demos(config, out)
    start = first_seed(config, config.compare.evaluation_seed)
    check_disjoint(range(start, start + (config.episodes or 0)), training_seeds(config, out))
    return config


def prepare(config: ExperimentConfig, out: Path) -> ExperimentConfig:
    """Record, train or find what the jobs share; finished parts are skipped.

    Args:
        config: of the comparison, checked.
        out: its folder.

    Returns:
        The config with `data` and `run` complete.

    Raises:
        DataError, CheckpointError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.recipes import train_dynamics, train_slots
    from playslot_rl.recipes.pipeline import collect_videos
    from playslot_rl.studies.plan import latent_models, model_folder, uses_demos, uses_slots

    models = latent_models(config)
    world = uses_slots(config) and not config.run
    if uses_demos(config) or (world and config.collect.learn_from_demos):
        config = replace(config, data=_demos(config, out))
    if (world or models) and not config.data.root:
        config = replace(config, data=collect_videos(config, out))
    if world:
        model = out / "world_model"
        for stage in (train_slots, train_dynamics):
            stage.main(replace(config, out=str(model), run=""))
        config = replace(config, run=str(model))
    for name, method in models.items():
        folder = model_folder(out, name)
        recipe = importlib.import_module(f"playslot_rl.recipes.{METHODS[method].recipe}")
        recipe.train_model(replace(config, out=str(folder), run="", method=method), folder)
    return config


def _known(config: ExperimentConfig) -> DataConfig:
    """`data` with the videos the world model of `run` was trained on, where none are named and those are there."""
    stored = Path(config.run) / "config.json"
    if config.data.root or config.run in ("", "pretrained") or not stored.is_file():
        return config.data
    try:
        root = from_dict(ExperimentConfig, json.loads(stored.read_text())).data.root
    except ValueError as error:
        raise ConfigError(f"{stored} cannot be used: {error}; name the videos by data.root=") from error
    there = root and all((Path(part.path) / "meta" / "info.json").is_file() for part in data_roots(root))
    return replace(config.data, root=root) if there else config.data


def _check_demos(config: ExperimentConfig, out: Path) -> None:
    from playslot_rl.studies.plan import check_demos, uses_demos
    from playslot_rl.training.record import open_videos

    if uses_demos(config) and (config.data.demos or _recorded(out)):
        where = config.data.demos or str(out / RECORDED)
        check_demos(config, _episodes(where), f"data.demos={where}")
        open_videos(config, where, "compare").require_actions(config.env.action_dim)


def _recorded(out: Path) -> bool:
    """Whether this comparison has recorded its demonstrations."""
    return (out / RECORDED / "meta" / "info.json").is_file()


def _episodes(root: str | Path) -> int:
    from playslot_rl.data.agreement import open_files

    return len(open_files(root).episodes)


def _demos(config: ExperimentConfig, out: Path) -> DataConfig:
    """Enough demonstrations for the largest number; at least the preset's, so that the first ones stay the same."""
    from playslot_rl.recipes.pipeline import collect_demos

    most, more = max(config.collect.expert_episodes, *config.compare.demos), config.collect.validation_episodes
    there = _episodes(out / RECORDED) if not config.data.demos and _recorded(out) else 0
    if there not in (0, most + more):
        most = there  # recorded for other numbers, or without ones to hold out
    return collect_demos(replace(config, collect=replace(config.collect, expert_episodes=most)), out)


class Parents:
    """Fingerprints of what jobs build on: weights by stage, and the demonstrations they take.

    Args:
        config: of the comparison, complete.
        out: its folder.
    """

    def __init__(self, config: ExperimentConfig, out: Path) -> None:
        from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
        from playslot_rl.studies.plan import latent_models, model_folder, uses_demos, uses_slots
        from playslot_rl.training.record import open_videos
        from playslot_rl.training.runs import world_model_checkpoints

        stages = world_model_checkpoints(config.run).items() if uses_slots(config) else ()
        self._world = {name: stage.fingerprint for name, stage in stages}
        self._models = {
            stage: read_stage(checkpoint_folder(model_folder(out, stage), stage), stage).fingerprint
            for stage in latent_models(config)
        }
        self._demos = open_videos(config, config.data.demos, "compare") if uses_demos(config) else None

    def of(self, job: Job) -> dict[str, str]:
        """Of one job."""
        from playslot_rl.data.views import first_demonstrations

        prints = dict(self._world) if METHODS[job.method].slots else {}
        if model := METHODS[job.method].model:
            prints[model] = self._models[model]
        if job.demos is not None and self._demos is not None:
            prints["demos"] = first_demonstrations(self._demos, job.demos).fingerprint  # the draw is in its config
        return prints
