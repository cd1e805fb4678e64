"""What the jobs of a comparison of success share, made once: demonstrations, videos, the world model, other models of
videos."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.collectors.presets import collect_demos, collect_videos
from playslot_rl.config import DataConfig, ExperimentConfig, from_dict
from playslot_rl.config.compose import is_pretrained
from playslot_rl.config.methods import METHODS
from playslot_rl.config.weights import data_roots
from playslot_rl.data.agreement import open_files
from playslot_rl.data.views import first_demonstrations
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.seeds import held_out_seeds
from playslot_rl.runs import Run
from playslot_rl.studies.several import Commands
from playslot_rl.studies.success.jobs import SuccessJob, latent_models, model_folder, uses_demos, uses_slots
from playslot_rl.training.record import open_videos

RECORDED = Path("data") / "expert"


def check_data(config: ExperimentConfig) -> ExperimentConfig:
    """The config with the data sets that are known already; refuses those that do not fit, before anything is written.

    Raises:
        ConfigError: too few demonstrations, or an evaluation seed among the training seeds.
        DataError: a data set cannot be read, or the demonstrations have no actions.
    """
    out = Path(config.out)
    config = replace(config, data=_known(config), method="playslot", demos=None)
    if uses_demos(config) and (config.data.demos or _recorded(out)):
        where = config.data.demos or str(out / RECORDED)
        check_demos(config, _episodes(where), f"data.demos={where}")
        open_videos(config, where, "compare").require_actions(config.env.action_dim)
    held_out_seeds(config, config.compare.evaluation_seed, config.episodes or 0, out)
    return config


def check_demos(config: ExperimentConfig, episodes: int, where: str) -> None:
    """Refuse more demonstrations than there are.

    Raises:
        ConfigError: there are fewer.
    """
    most = max(config.compare.demos)
    if most > episodes:
        raise ConfigError(
            f"demos: got {most}, expected at most the {episodes} demonstrations of {where}: lower it or collect more"
        )


def prepare_shared(config: ExperimentConfig, commands: Commands) -> ExperimentConfig:
    """Record, train or find what the jobs share, finished parts excepted; the config with `data` and `run` complete.

    Raises:
        DataError, CheckpointError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    out, models = Path(config.out), latent_models(config)
    world = uses_slots(config) and not config.run
    if uses_demos(config) or (world and config.collect.learn_from_demos):
        config = replace(config, data=_demos(config, out))
    if (world or models) and not config.data.root:
        config = replace(config, data=collect_videos(config, out))
    if world:
        model = str(out / "world_model")
        for command in ("train-slots", "train-dynamics"):
            commands[command](replace(config, out=model, run=""))
        config = replace(config, run=model)
    for stage, method in models.items():
        commands["train-videos"](replace(config, out=str(model_folder(out, stage)), run="", method=method))
    return config


def _known(config: ExperimentConfig) -> DataConfig:
    """`data` with the videos the world model of `run` was trained on, where none are named and those are there."""
    stored = Path(config.run) / "config.json"
    if config.data.root or not config.run or not stored.is_file():
        return config.data
    try:
        root = from_dict(ExperimentConfig, json.loads(stored.read_text())).data.root
    except ValueError as error:
        raise ConfigError(f"{stored} cannot be used: {error}; name the videos by data.root=") from error
    there = root and all((Path(part.path) / "meta" / "info.json").is_file() for part in data_roots(root))
    return replace(config.data, root=root) if there else config.data


def _recorded(out: Path) -> bool:
    """Whether this comparison has recorded its demonstrations."""
    return (out / RECORDED / "meta" / "info.json").is_file()


def _episodes(root: str | Path) -> int:
    return len(open_files(root).episodes)


def _demos(config: ExperimentConfig, out: Path) -> DataConfig:
    """Enough demonstrations for the largest number; at least the preset's, so that the first ones stay the same."""
    most, more = max(config.collect.expert_episodes, *config.compare.demos), config.collect.validation_episodes
    there = _episodes(out / RECORDED) if not config.data.demos and _recorded(out) else 0
    if there not in (0, most + more):
        most = there  # recorded for other numbers, or without ones to hold out
    return collect_demos(replace(config, collect=replace(config.collect, expert_episodes=most)), out)


class Shared:
    """What was made or found: what jobs build on, and what the result says of it."""

    def __init__(self, config: ExperimentConfig) -> None:
        self._world = Run.open(config.run).world_stages if uses_slots(config) else {}
        self._source = config.run if is_pretrained(config.run) else Path(config.run).name
        self._models = {stage: Run(model_folder(Path(config.out), stage)).own(stage) for stage in latent_models(config)}
        self._demos = open_videos(config, config.data.demos, "compare") if uses_demos(config) else None

    def parents(self, job: SuccessJob) -> dict[str, str]:
        """Fingerprints of the weights, by stage, and of the demonstrations that a job builds on."""
        method = METHODS[job.method]
        prints = {name: stage.fingerprint for name, stage in self._world.items()} if method.slots else {}
        if method.model:
            prints[method.model.name] = self._models[method.model.name].fingerprint
        if job.demos is not None and self._demos is not None:
            prints["demos"] = first_demonstrations(self._demos, job.demos).fingerprint  # the draw is in its config
        return prints

    def plain(self) -> dict[str, Any]:
        """`world_model` (null where no method builds on one), and the models of videos by stage, `latent_models`."""
        world = None
        if self._world:
            world = {
                "source": self._source,
                "fingerprints": {name: stage.fingerprint for name, stage in self._world.items()},
                "seconds": sum(float(stage.meta.get("seconds", 0.0)) for stage in self._world.values()),
                "episodes": self._world["slots"].meta.get("episodes"),
            }
        kept = ("fingerprint", "seconds", "episodes")
        models = {name: {key: stage.meta.get(key) for key in kept} for name, stage in self._models.items()}
        return {"world_model": world, "latent_models": models}
