"""The clips a video comparison is tested on: of episodes that no training saw, the same for every method and seed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.opening import open_configured
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import split_tested
from playslot_rl.data.windows import IntArray, spread_windows
from playslot_rl.errors import ConfigError, DataError


def test_sets(config: ExperimentConfig) -> dict[str, str]:
    """The data sets whose clips are tested, by folder name; one of them, or episodes kept of `data.root`, has none.

    Raises:
        ConfigError: two folders of one name.
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
    """Clips that are predicted from some seed frames on.

    Attributes:
        label: of their test set; empty where it is the only one.
        shown: seed frames.
        source: the episodes.
        rows: of each clip's frames, int64 (clips, shown + predicted).
    """

    label: str
    shown: int
    source: EpisodeFrames
    rows: IntArray

    @property
    def fingerprint(self) -> str:
        """Of the true frames."""
        return hashlib.sha256(self.source.frames[self.rows].tobytes()).hexdigest()[:16]


def tested_clips(config: ExperimentConfig) -> Iterator[Tested]:
    """The clips of each test set after each number of seed frames.

    Raises:
        DataError: see `open_clips`.
    """
    own = config.compare_video
    for label, test in test_sets(config).items():
        for shown in own.shown:
            yield Tested(label, shown, *open_clips(config, test, shown + own.predicted, own.clips))


def sheet_name(label: str, shown: int) -> str:
    """Name of the frames of a test set (empty where it is the only one) after some seed frames."""
    return f"frames_{label}_{shown}" if label else f"frames_{shown}"


def open_clips(config: ExperimentConfig, test: str, frames: int, count: int) -> tuple[EpisodeFrames, IntArray]:
    """Clips of a test set.

    Args:
        config: names `data.root`.
        test: the data set; empty takes the episodes that are kept of `data.root`.
        frames: T, of a clip.
        count: clips, at most; they do not overlap, and are spread evenly over the episodes.

    Returns:
        The episodes, and row numbers (at most `count`, T).

    Raises:
        DataError: too few episodes, none so long, fewer than two clips, or a data set that cannot be read.
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
