"""What of the data sets that a command names a stage is shown: all but the episodes that are kept to measure on, and
those are told here alone, by where a set lies, however its name is written.

    kept for a test           `data.tested`, a share of the episodes, of any sets
    held-out demonstrations   of what is left of `data.demos` (empty: what is named) the last `data.held_out`; with
                              several tasks in one environment those of each in proportion (`playslot_rl.data.turns`)
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import data_roots, is_remote
from playslot_rl.data.demonstrations import free_demonstrations
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.turns import turns
from playslot_rl.data.views import (
    IntArray,
    by_turns,
    chosen_episodes,
    episode_range,
    recorded_tasks,
    split_tested,
    tested_numbers,
)
from playslot_rl.data.weighted import open_configured, weighted
from playslot_rl.errors import DataError


def place(root: str) -> str:
    """Where a data set lies: its folder without links, or its address on the Hub."""
    return root.rstrip("/") if is_remote(root) else str(Path(root).expanduser().resolve())


def places(roots: str) -> list[str]:
    """Of each of several data sets."""
    return [place(root.path) for root in data_roots(roots)]


def open_videos(config: ExperimentConfig, roots: str, what: str, whole: bool = True) -> EpisodeFrames:
    """Open the data sets of a stage without what is kept for a test and without held-out demonstrations; with these
    where `whole` and all of the sets are demonstrations: who takes them holds out the last ones.

    Raises:
        DataError: none is named, one cannot be read, or nothing is left.
    """
    if not roots:
        raise DataError(f"{what}: got no data set, expected data.root=DIR; record one by `playslot collect`")
    data = config.data
    here, shown = {*places(roots)}, {*places(data.demos or roots)}
    cut = bool(data.held_out and here & shown and not (whole and here <= shown))
    opened = functools.cache(functools.partial(open_configured, config))
    held = _held_out(config, data.demos or roots, opened) if cut else {}
    if not any(len(held.get(name, ())) for name in here):
        source = open_configured(config, roots)
        source = split_tested(source, data.tested)[0] if data.tested else source
        return by_turns(source) if config.env.tasks and whole and here <= shown else source
    named = data_roots(roots)
    parts = [opened(root.path) for root in named]
    out = [held.get(place(root.path), np.zeros(0, np.int64)) for root in named]
    if data.tested:
        before = np.cumsum([0, *(part.recordings for part in parts)])
        numbers = np.concatenate([some + start for some, start in zip(out, before, strict=False)])
        kept = np.setdiff1d(tested_numbers(int(before[-1]), data.tested)[0], numbers)
        how = f"tested {data.tested:g} without {' '.join(map(str, numbers))}"
        return chosen_episodes(open_configured(config, roots), kept, how)
    left = [
        (_without(part, some), root.weight)
        for part, root, some in zip(parts, named, out, strict=True)
        if len(some) < part.recordings
    ]
    if not left:
        raise DataError(f"data.root={roots}: got held-out demonstrations alone, expected others: lower data.held_out")
    return weighted([part for part, _ in left], [weight for _, weight in left])


def _without(source: EpisodeFrames, some: IntArray) -> EpisodeFrames:
    """A set without some of its episodes. They are told by how many are left where they are its last: another number
    would be another set to a finished stage."""
    if not len(some):
        return source
    kept = np.setdiff1d(np.arange(source.recordings), some)
    if kept[-1] == len(kept) - 1:
        return episode_range(source, 0, len(kept))
    return chosen_episodes(source, kept, f"without {' '.join(map(str, some))}")


def _held_out(config: ExperimentConfig, roots: str, opened: Callable[[str], EpisodeFrames]) -> dict[str, IntArray]:
    """Numbers of the held-out episodes of each set of demonstrations, by its place; a DataError where all would be."""
    paths, data = [root.path for root in data_roots(roots)], config.data
    counts = [opened(path).recordings for path in paths]
    total = sum(counts)
    found = [recorded_tasks(opened(path)) for path in paths] if config.env.tasks else []
    tasks = list(itertools.chain.from_iterable(found)) if all(found) else []

    def last_of(numbers: IntArray) -> IntArray:
        order = turns([tasks[number] for number in numbers]) if tasks else slice(None)
        return numbers[order][free_demonstrations(len(numbers), data.held_out) :]

    last = np.sort(last_of(np.arange(total)))
    if data.tested:  # the last of all, too: who measures may not know of the test
        last = np.union1d(last, last_of(tested_numbers(total, data.tested)[0]))
    ends = np.cumsum(counts)
    pairs = zip(paths, ends - counts, ends, strict=True)
    return {place(path): last[(last >= begin) & (last < end)] - begin for path, begin, end in pairs}
