"""What a finished stage says of the episodes that taught it, so that a measure keeps to others, and of their actions:
their mean is what a policy has to beat.

Shapes: A action width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import transitions
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.data.windows import split_episodes


def taught(source: EpisodeFrames, config: ExperimentConfig, extra: Mapping[str, Any], demos: bool) -> dict[str, Any]:
    """For the checkpoint of a stage with `extra` facts: `trained_on`, the `origins` of its episodes, of clips
    (`StageRecord.seen`) without those that validated; of demonstrations the mean of the actions that it was shown, of
    videos how many demonstrations were left out, which share of the clips validates, and how a stream was shuffled.
    """
    training: IntArray = np.arange(source.episodes)
    if "clip_frames" in extra:
        fits = source.lengths >= extra["clip_frames"]
        training, _ = split_episodes(source.episodes, config.data.validation, config.seed, fits, source.recorded)
    origins = None if source.origins is None else sorted(set(source.origins[training].tolist()))
    if demos:
        return {"trained_on": origins, **mean_actions(source, extra.get("labelled_demos"))}
    own = config.data
    drawn = {"shuffle_buffer": own.shuffle_buffer} if own.stream else {}
    return {"trained_on": origins, "held_out": own.held_out, "validation": own.validation, **drawn}


def mean_actions(source: EpisodeFrames, labelled: int | None) -> dict[str, list[float]]:
    """`action_mean` and `action_deviation` (A,) of the transitions of the first `labelled` demonstrations (None: all),
    as they were recorded; nothing where none has actions."""
    moves = transitions(source)
    shown = moves.rows[moves.episode < (source.recordings if labelled is None else labelled)]
    actions = np.zeros((0, 1)) if source.actions is None else source.actions[shown].astype(np.float64)
    actions = actions[np.isfinite(actions).all(axis=1)]
    if not len(actions):
        return {}
    return {"action_mean": actions.mean(axis=0).tolist(), "action_deviation": actions.std(axis=0).tolist()}
