"""The clips a video comparison is tested on: of episodes that no training saw, the same for every method and seed."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import split_tested
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.windows import IntArray, spread_windows
from playslot_rl.errors import DataError


def open_clips(config: ExperimentConfig, frames: int, count: int) -> tuple[EpisodeFrames, IntArray]:
    """The test episodes, of `compare_video.test` or else those kept of `data.root`, and clips of them.

    Args:
        config: `data`, `env`, `compare_video`.
        frames: T, of a clip.
        count: clips, at most; they do not overlap, and are spread evenly over the episodes.

    Returns:
        The episodes, and row numbers (at most `count`, T), int64.

    Raises:
        DataError: too few episodes, none so long, fewer than two clips, or a data set that cannot be read.
    """
    data, root = config.data, config.compare_video.test or config.data.root
    size, resize = config.env.image_size, data.resize
    source = open_sources(root, data.camera, data.cache, image_size=size, resize=resize)
    tested = source if config.compare_video.test else split_tested(source, data.tested)[1]
    rows = spread_windows(tested.starts, tested.lengths, frames, count, range(tested.episodes))
    if len(rows) < 2:
        raise DataError(
            f"data.root={root}: got {len(rows)} held-out clip of {frames} frames, expected at least 2: collect more "
            "episodes, or raise compare_video.tested"
        )
    return tested, rows
