"""Episodes of environments that are drawn, not simulated (GridShapes): no environment, no policy, no workers.

Drawing is so quick (docs/gridshapes.md) that a pool of processes would not start before one has finished.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from playslot_rl.collectors.episodes import RecordedEpisode
from playslot_rl.collectors.spec import CollectionSpec
from playslot_rl.envs.grid_shapes import generate

CLIPS_AT_ONCE = 64


def record(spec: CollectionSpec, indices: Sequence[int], workers: int = 1) -> Iterator[RecordedEpisode]:
    """Draw the episodes `indices` of a collection.

    Args:
        spec: the collection.
        indices: which of its episodes.
        workers: taken for the sake of `playslot_rl.collectors.episodes.record`; the clips are drawn in this process.

    Yields:
        Each episode once. Actions say what the objects did, states where they were; reward and success are zero.
    """
    del workers
    for first in range(0, len(indices), CLIPS_AT_ONCE):
        some = indices[first : first + CLIPS_AT_ONCE]
        seeds = [spec.episode_seed(index) for index in some]
        clips = generate(seeds, spec.steps, spec.env)
        for number, (index, seed) in enumerate(zip(some, seeds, strict=True)):
            yield RecordedEpisode(
                index=index,
                seed=seed,
                redrawn=0,
                frames=clips.frames[number],
                states=clips.states[number],
                actions=clips.actions[number],
                rewards=np.zeros(spec.steps, np.float32),
                success=np.zeros(spec.steps, np.bool_),
            )
