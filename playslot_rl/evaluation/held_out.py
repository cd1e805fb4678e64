"""What measures a run: episodes of a data set that a world model was not trained on, as far as that can be told, and
evaluation seeds, a fixed list, never one that was collected for training.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.config.weights import data_roots
from playslot_rl.data.demonstrations import split_demonstrations
from playslot_rl.data.metadata import RECORD_NAME, read_record
from playslot_rl.data.places import Problems, parquet_files
from playslot_rl.data.prints import of_pictures
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tables import read_table
from playslot_rl.data.windows import split_episodes, spread_evenly
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.seeds.episodes import episode_seed

Ints = npt.NDArray[np.int64]
NOT_SAID = "the checkpoints do not say whether the world model"


@dataclass(frozen=True)
class HeldOut:
    """Episodes to measure on, and others that probes are fitted on.

    Attributes:
        fitted, tested: sorted episode numbers; `fitted` may be empty.
        told_by: why the tested ones are held out, or that it cannot be told, as part of a sentence.
        known: whether it can be told that no stage was trained on the tested ones.
    """

    fitted: Ints
    tested: Ints
    told_by: str
    known: bool

    def subset(self, source: EpisodeFrames) -> tuple[EpisodeFrames, npt.NDArray[np.bool_]]:
        """The fitted episodes, then the tested ones, as a source of their own; which of its episodes are tested (E,).
        Its frames are those of the whole data set: rows are `starts` and on.
        """
        chosen = np.concatenate([self.fitted, self.tested])
        tested = np.arange(len(chosen)) >= len(self.fitted)
        some = replace(source, starts=source.starts[chosen], lengths=source.lengths[chosen], recorded=None)
        return some, tested


def hold_out(source: EpisodeFrames, metas: Mapping[str, Mapping[str, Any]], config: DataConfig, most: int) -> HeldOut:
    """Choose at most `most` episodes of two frames or more, a quarter of them at most to test on; a DataError where
    there is none. All views of a recorded episode lie on one side.

    Of the world model's own videos, as the fingerprints in the checkpoints' `metas` by stage tell, those are tested
    that its validation held out; of the policy's demonstrations the last ones, as many as were held out; of any other
    set the last `data.held_out`, or else its last quarter.
    """
    usable = np.flatnonzero(source.lengths >= 2).astype(np.int64)
    if len(usable) == 0:
        raise DataError(
            f"data.root: got {source.episodes} episodes of one frame, expected some of two frames or more: "
            "a latent action lies between two frames"
        )
    candidates, told_by, known = _candidates(source, metas, config, usable)
    tested = spread_evenly(candidates, max(1, min(len(candidates), most // 4)))
    fitted = spread_evenly(np.setdiff1d(usable, candidates), max(0, most - len(tested)))
    return HeldOut(fitted, tested, told_by, known)


def _candidates(
    source: EpisodeFrames, metas: Mapping[str, Mapping[str, Any]], config: DataConfig, usable: Ints
) -> tuple[Ints, str, bool]:
    numbers = source.numbers[usable]
    quarter = usable[np.isin(numbers, _last_quarter(source, numbers))]
    world = {stage: metas[stage] for stage in ("slots", "dynamics") if stage in metas}
    trained = [meta for meta in world.values() if str(meta.get("data", {}).get("train", "")) == source.fingerprint]
    if trained:
        chosen = usable
        for meta in trained:  # each stage holds out by its own seed and clips; checkpoints of before say no share
            share, fits = float(meta.get("validation", config.validation)), source.lengths >= meta.get("clip_frames", 1)
            training, _ = split_episodes(source.episodes, share, int(meta.get("seed", 0)), fits, source.recorded)
            chosen = np.setdiff1d(chosen, training)
        chosen = _apart(source, world, chosen)
        if len(chosen) and len(trained) == len(world):
            return chosen, "the world model's own videos, the episodes that its validation held out", True
        if len(chosen):
            stage = "dynamics" if trained[0] is metas.get("slots") else "slots"
            why = f"one stage's videos, the episodes that it held out; {stage} had another set, which may hold them"
            return chosen, why, False
        return quarter, "the world model's own videos, none of which were held out", False
    last = _policy_held_out(source, metas.get("policy", {}), config)
    for count in filter(None, (last, config.held_out)):
        chosen = usable[numbers >= source.recordings - count]
        chosen = left if len(left := _apart(source, world, chosen)) else chosen
        unseen = bool(world) and all(seen == 0 for seen in trained_on(source, world, chosen).values())
        if len(chosen) and count == last:
            unseen &= all(int(meta.get("held_out", 0)) >= last for meta in world.values())
            why = "training" if unseen else f"the policy's training; {NOT_SAID}, too"
            return chosen, f"the last {last} episodes, which are held out from {why}", unseen
        if len(chosen):
            return chosen, f"the last {count} episodes, as data.held_out says", unseen
    return quarter, f"the last quarter of the episodes; {NOT_SAID} was trained on them", False


def _apart(source: EpisodeFrames, metas: Mapping[str, Mapping[str, Any]], chosen: Ints) -> Ints:
    """Those of some episodes that no stage says it was trained on: one recording can be in several data sets."""
    seen = {origin for meta in metas.values() for origin in meta.get("trained_on") or ()}
    if source.origins is None:
        return chosen
    return chosen[np.array([origin not in seen for origin in source.origins[chosen].tolist()], np.bool_)]


def trained_on(
    source: EpisodeFrames, metas: Mapping[str, Mapping[str, Any]], chosen: Ints | slice = slice(None)
) -> dict[str, int | None]:
    """How many of some episodes each stage was trained on, as its checkpoint's meta says; None where that does not say
    what it saw, or nobody knows which episodes these are.
    """
    there = None if source.origins is None else {*source.origins[chosen].tolist()}

    def count(ones: Iterable[str] | None) -> int | None:
        if there is None or ones is None:
            return None
        # A stage that says nothing of pictures may have seen these: versions before knew none.
        known = any(map(of_pictures, ones)) or not any(map(of_pictures, there))
        return len(there & {*ones}) or (0 if known else None)

    return {name: count(meta.get("trained_on")) for name, meta in metas.items()}


def _last_quarter(source: EpisodeFrames, numbers: Ints) -> Ints:
    """The last quarter of some recorded episodes; where only some have actions, of those and of the others."""
    silent = np.isin(numbers, source.numbers[source.silent])
    parts = [part for part in (np.unique(numbers[~silent]), np.unique(numbers[silent])) if len(part)]
    return np.concatenate([part[-max(1, len(part) // 4) :] for part in parts])


def _policy_held_out(source: EpisodeFrames, policy: Mapping[str, Any], config: DataConfig) -> int:
    """How many of the last episodes the policy's training held out, if this is the set it was trained on; else 0."""
    held, demos = int(policy.get("held_out_demos", 0)), int(policy.get("demos", 0))
    if not held or not 0 < demos <= source.recordings - held:
        return 0
    # Its checkpoint names the demonstrations it was trained on, which a draw may have chosen, or their actions.
    ways = itertools.product({None, config.draw, int(policy.get("seed", 0))}, (False, True))
    prints = {split_demonstrations(source, demos, held, held, *way).trained.fingerprint for way in ways}
    return held if policy.get("data", {}).get("demos") in prints else 0


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
    """Episode seeds that a data set says it was collected with, in our record of it or in its column `seed`; empty for
    foreign data sets. A DataError where there is a record that cannot be used, and no such column.
    """
    record = read_record(root)
    seeds = [entry.get("seed") for entry in (record or {}).get("episodes", ())]
    for path in parquet_files(root, "data"):
        table = read_table(path, Problems(), keys.FEATURE_SEED.__eq__)
        if table is not None and table.num_columns:
            seeds += np.unique(table.column(0).drop_null().to_numpy()).tolist()
    if record is None and not seeds and (root / RECORD_NAME).is_file():
        raise DataError(f"{root / RECORD_NAME}: got no record of episodes, expected JSON; collect the data set again")
    return {seed for seed in seeds if isinstance(seed, int)}


def data_folders(config: ExperimentConfig, run: Path | None = None) -> list[Path]:
    """Data sets the config names, then what is in the run's `data` folder, each once."""
    named = [Path(root.path).expanduser() for root in data_roots(f"{config.data.root},{config.data.demos}")]
    named += sorted((run / "data").glob("*")) if run is not None else []
    once: dict[Path, Path] = {}
    for path in named:
        once.setdefault(path.resolve(), path)
    return [*once.values()]


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
