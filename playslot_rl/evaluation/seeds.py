"""Evaluation seeds: a fixed list, never one that was collected for training."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.seeds.episodes import episode_seed


def first_seed(config: ExperimentConfig, seed: int) -> int:
    """First evaluation seed of `seed`; the others follow it one by one."""
    return episode_seed("evaluation", seed, 0, config.evaluation.seed_offset)


def held_out_seeds(config: ExperimentConfig, seed: int, episodes: int, run: Path | None = None) -> list[int]:
    """The first evaluation seeds of `seed`; a ConfigError where a training data set that the config names, or one in
    the run's `data` folder, holds one of them.
    """
    first = first_seed(config, seed)
    seeds = list(range(first, first + episodes))
    check_disjoint(seeds, training_seeds(config, run))
    return seeds


def recorded_seeds(root: Path) -> set[int]:
    """Episode seeds that one of our data sets says it was collected with; empty for foreign data sets. A DataError
    where `meta/playslot.json` is there but cannot be read.
    """
    path = root / "meta" / "playslot.json"
    if not path.is_file():
        return set()
    try:
        meta = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise DataError(f"{path}: got {error}, expected JSON; collect the data set again") from error
    return set(_seeds_in(meta))


def _seeds_in(node: Any) -> Iterable[int]:
    """All integers under a key `seed` or `seeds`, at any depth below the per-episode records."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "seeds" and isinstance(value, list):
                yield from (int(v) for v in value if isinstance(v, int))
            elif key == "episodes" and isinstance(value, list):
                yield from (int(v["seed"]) for v in value if isinstance(v, dict) and isinstance(v.get("seed"), int))
            else:
                yield from _seeds_in(value)


def data_folders(config: ExperimentConfig, run: Path | None = None) -> list[Path]:
    """Data sets the config names, then what is in the run's `data` folder."""
    named = [Path(root.path) for root in data_roots(f"{config.data.root},{config.data.demos}")]
    return [*named, *(sorted((run / "data").glob("*")) if run is not None else [])]


def training_seeds(config: ExperimentConfig, run: Path | None = None) -> set[int]:
    """Episode seeds of every data set the config (or the run's `data` folder) names."""
    return {seed for root in data_folders(config, run) for seed in recorded_seeds(root)}


def check_disjoint(seeds: Iterable[int], training: set[int]) -> None:
    """Refuse evaluation seeds that a training data set holds, by a ConfigError."""
    common = sorted(set(seeds) & training)
    if common:
        raise ConfigError(
            f"evaluation.seed_offset: got evaluation seed {common[0]} that is in a training data set "
            f"({len(common)} in all), expected seeds apart; choose another evaluation.seed_offset"
        )
