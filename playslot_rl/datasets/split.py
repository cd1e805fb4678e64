"""One data set as several, by episodes: for training and validation, or one for each task."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from playslot_rl.datasets.assemble import assemble, choose
from playslot_rl.datasets.verify import Verification, require_sound, require_verified
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.seeds.episodes import LARGEST_DRAW
from playslot_rl.storage.folders import new_folder, require_free


@dataclass(frozen=True)
class SplitResult:
    """What `split` made: the episodes of the source in each part, ascending."""

    out: Path
    episodes: dict[str, tuple[int, ...]]
    verifications: dict[str, Verification]

    def lines(self) -> list[str]:
        return [
            f"{self.out / name}: {made.episodes} episodes, {made.frames} frames, fingerprint {made.fingerprint}"
            for name, made in self.verifications.items()
        ]


def split(
    root: str | Path, out: str | Path, fractions: Mapping[str, float] | None = None, *, seed: int = 0
) -> SplitResult:
    """Deal a data set's episodes out to new data sets `out/NAME`; each episode goes to exactly one, none is lost.

    Which episodes go where depends on `seed` alone, or on their tasks; within a part they keep their order. Frames are
    unchanged. A kill leaves no `out`.

    Args:
        fractions: name -> share, each more than 0, together 1; None makes a part of each task, named by its words.

    Raises:
        ConfigError: a negative or absurd seed.
        DataError: a name that is no folder name, shares that do not add up, too few episodes, an episode of several
            tasks, or a damaged data set.
        OutputError: `out` exists, or the disk is full.
    """
    if not 0 <= seed <= LARGEST_DRAW:
        raise ConfigError(f"seed: got {seed}, expected a whole number from 0 to {LARGEST_DRAW}")
    target = Path(out)
    if fractions is not None:
        _require_shares(fractions)
    require_free(target, "--out ")
    contents = require_sound(root)
    if fractions is None:
        parts = by_task([episode.tasks for episode in contents.episodes], contents.root)
    else:
        parts = draw(len(contents.spans), fractions, seed)
    made = {}
    with new_folder(target, key="--out ") as temporary:
        for name, indices in parts.items():
            assemble([choose(contents, indices)], temporary / name, "playslot dataset split")
            made[name] = require_verified(temporary / name, [contents.root])
    return SplitResult(target, {name: tuple(indices) for name, indices in parts.items()}, made)


def _require_shares(fractions: Mapping[str, float]) -> None:
    for name, share in fractions.items():
        if not name.replace("-", "").replace("_", "").isalnum() or not 0 < share <= 1:
            raise DataError(
                f"fractions: got {name}={share:g}, expected a plain name and a share of more than 0, at most 1"
            )
    total = sum(fractions.values())
    if abs(total - 1) > 1e-6:
        raise DataError(f"fractions: got a sum of {total:g}, expected 1, as in train=0.9,val=0.1")


def by_task(tasks: Sequence[Sequence[str]], root: Path) -> dict[str, list[int]]:
    """Episodes of each task, ascending, by plain names of their words; a DataError where one has several."""
    parts: dict[str, list[int]] = {}
    for index, words in enumerate(tasks):
        if len(words) > 1:
            raise DataError(
                f"{root}: got episode {index} of the tasks {', '.join(map(repr, words))}, expected one in each episode "
                "to split by tasks: split by --fractions"
            )
        parts.setdefault(words[0] if words else "", []).append(index)
    plain = {words: re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")[:60] or "task" for words in parts}
    names, taken = list(plain.values()), dict[str, list[int]]()
    for number, (words, indices) in enumerate(parts.items()):
        taken[f"{plain[words]}_{number}" if names.count(plain[words]) > 1 else plain[words]] = indices
    return taken


def draw(episodes: int, fractions: Mapping[str, float], seed: int) -> dict[str, list[int]]:
    """Episodes of each part, ascending: sizes by largest remainders, that add up. A DataError if one is empty."""
    exact = {name: share * episodes for name, share in fractions.items()}
    sizes = {name: int(value) for name, value in exact.items()}
    for name in sorted(exact, key=lambda name: sizes[name] - exact[name])[: episodes - sum(sizes.values())]:
        sizes[name] += 1
    empty = [name for name, size in sizes.items() if not size]
    if empty:
        raise DataError(
            f"fractions: got {fractions[empty[0]]:g} of {episodes} episodes for {empty[0]}, expected at least one "
            "episode in each part; use a larger share"
        )
    order = np.random.default_rng(seed).permutation(episodes)
    parts = np.split(order, np.cumsum(list(sizes.values()))[:-1])
    return {name: sorted(part.tolist()) for name, part in zip(sizes, parts, strict=True)}
