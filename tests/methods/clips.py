"""Small videos for the baselines: a bright square that a known action moves."""

from __future__ import annotations

import numpy as np

from playslot_rl.data.source import EpisodeFrames


def moving_square(episodes: int = 4, length: int = 6, size: int = 32, seed: int = 0) -> EpisodeFrames:
    """Episodes in which a square of 8 pixels moves 4 pixels left or right a step; action 0 is the direction."""
    numbers = np.random.default_rng(seed)
    frames = np.full((episodes * length, size, size, 3), 40, np.uint8)
    actions = np.zeros((episodes * length, 2), np.float32)
    for episode in range(episodes):
        x, y = int(numbers.integers(4, size - 12)), int(numbers.integers(0, size - 8))
        for step in range(length):
            row = episode * length + step
            frames[row, y : y + 8, x : x + 8] = (220, 60, 60)
            direction = -1 if x > size - 13 else 1 if x < 4 else int(numbers.choice([-1, 1]))
            actions[row, 0] = direction
            x += 4 * direction
    return EpisodeFrames(
        frames=frames,
        starts=np.arange(episodes) * length,
        lengths=np.full(episodes, length),
        actions=actions,
        seeds=np.arange(episodes),
        fingerprint="square",
        fps=10.0,
        task="",
        camera="",
    )
