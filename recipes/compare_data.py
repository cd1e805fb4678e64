"""What the jobs of a comparison share, made once: demonstrations, videos, the world model, LAPO's models."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import DataConfig, ExperimentConfig, from_dict
from playslot_rl.errors import ConfigError


def prepare(config: ExperimentConfig, out: Path) -> ExperimentConfig:
    """Record, train or find what the jobs share; finished parts are skipped.

    Args:
        config: of the comparison.
        out: its folder.

    Returns:
        The config with `data` and `run` complete.

    Raises:
        ConfigError: too few demonstrations; before anything is computed.
        DataError, CheckpointError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.comparison.plan import uses_demos, uses_slots
    from playslot_rl.recipes import train_dynamics, train_slots
    from playslot_rl.recipes.baselines import lapo

    methods = config.compare.methods
    world = uses_slots(config) and not config.run
    config = replace(config, data=_known(config), method="playslot", demos=None)
    _check_demos(config)
    if uses_demos(config) or (world and config.collect.learn_from_demos):
        config = replace(config, data=_demos(config, out))
    if (world or "lapo" in methods) and not config.data.root:
        config = replace(config, data=_videos(config, out))
    if world:
        model = out / "world_model"
        for stage in (train_slots, train_dynamics):
            stage.main(replace(config, out=str(model), run=""))
        config = replace(config, run=str(model))
    if "lapo" in methods:
        lapo.train_model(replace(config, out=str(out / "lapo_world"), run="", method="lapo"), out / "lapo_world")
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
    there = root and all((Path(part) / "meta" / "info.json").is_file() for part in root.split(","))
    return replace(config.data, root=root) if there else config.data


def _check_demos(config: ExperimentConfig) -> None:
    from playslot_rl.comparison.plan import check_demos, uses_demos
    from playslot_rl.data.lerobot_files import open_files

    if config.data.demos and uses_demos(config):
        check_demos(config, len(open_files(config.data.demos).episodes), f"data.demos={config.data.demos}")


def _demos(config: ExperimentConfig, out: Path) -> DataConfig:
    """Enough demonstrations for the largest number; at least the preset's, so that the first ones stay the same."""
    from playslot_rl.recipes.pipeline import collect_demos

    most = max(config.collect.expert_episodes, *config.compare.demos)
    return collect_demos(replace(config, collect=replace(config.collect, expert_episodes=most)), out)


def _videos(config: ExperimentConfig, out: Path) -> DataConfig:
    from playslot_rl.recipes.pipeline import collect_videos

    return collect_videos(config, out)


def parents_of(method: str, world: str, out: Path) -> dict[str, str]:
    """Fingerprints of the weights a method's jobs build on, by stage.

    Args:
        method: its name.
        world: run folder of the world model, or `pretrained`; empty for a method without slots.
        out: folder of the comparison.
    """
    from playslot_rl.training.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.training.runs import world_model_checkpoints

    prints = {name: c.fingerprint for name, c in world_model_checkpoints(world).items()} if world else {}
    if method == "lapo":
        prints["lapo_model"] = read_stage(checkpoint_folder(out / "lapo_world", "lapo_model"), "lapo_model").fingerprint
    return prints
