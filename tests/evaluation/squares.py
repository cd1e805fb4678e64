"""Videos of a square that actions move."""

from __future__ import annotations

import numpy as np

from playslot_rl.data.source import EpisodeFrames

EPISODES, LENGTH = 12, 7


def videos(episodes: int = EPISODES, length: int = LENGTH, moving: bool = True) -> EpisodeFrames:
    """A square that is moved by the actions, in frames of 64x64."""
    generator = np.random.default_rng(0)
    frames = np.full((episodes * length, 64, 64, 3), 90, np.uint8)
    actions = generator.uniform(-1, 1, (len(frames), 4)).astype(np.float32)
    for episode in range(episodes):
        at = generator.uniform(20, 36, 2)
        for row in range(episode * length, (episode + 1) * length):
            x, y = at.astype(int)
            frames[row, y : y + 8, x : x + 8] = (220, 40, 40) if moving else (90, 90, 90)
            at = np.clip(at + 4 * actions[row, :2], 0, 56)
    starts = np.arange(episodes, dtype=np.int64) * length
    lengths = np.full(episodes, length, np.int64)
    return EpisodeFrames(frames, starts, lengths, actions, None, "print", 10.0, "", "camera")
