"""Data sets as a config wants them: its camera, its frame size, and every so-many-th frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.weights import DataRoot, data_roots
from playslot_rl.data.cache import Cache
from playslot_rl.data.source import EpisodeFrames, open_sources
from playslot_rl.data.views import every
from playslot_rl.data.weighted import weighted


def open_configured(config: ExperimentConfig, roots: str | Sequence[str | Path]) -> EpisodeFrames:
    """One or several data sets as one, by `env.image_size` and what `data` says of cameras, caches, size and stride.

    Args:
        roots: folders, or a text with commas and weights (`playslot_rl.config.weights`).

    Raises:
        DataError: as `open_sources`; or sets with weights do not agree.
        ConfigError: a weight that is not above 0.
    """
    named = data_roots(roots) if isinstance(roots, str) else [DataRoot(str(root), None) for root in roots]
    if any(root.weight is not None for root in named):
        parts = [open_configured(config, [root.path]) for root in named]
        return weighted(parts, [root.weight for root in named], [root.path for root in named])
    data, size = config.data, config.env.image_size
    paths = [root.path for root in named]
    buffer = data.shuffle_buffer if data.stream else None
    source = open_sources(paths, data.camera, Cache.of(data), image_size=size, resize=data.resize, buffer=buffer)
    return every(source, data.stride)
