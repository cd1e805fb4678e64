"""Data sets as a config wants them: its camera, its frame size, and every so-many-th frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.stride import every


def open_configured(config: ExperimentConfig, roots: str | Sequence[str | Path]) -> EpisodeFrames:
    """One or several data sets as one, by `env.image_size` and `data.camera`, `.cache`, `.resize` and `.stride`.

    Raises:
        DataError: as `open_sources`.
    """
    data, size = config.data, config.env.image_size
    source = open_sources(roots, data.camera, data.cache, image_size=size, resize=data.resize)
    return every(source, data.stride)
