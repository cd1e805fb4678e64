"""Episode seeds of learning by acting: apart from every collected and every evaluation seed.

Collected data have seeds below 10^9, evaluation those from 10^9 on (`playslot_rl.evaluation.seeds`), at most 2 * 10^9.
"""

from __future__ import annotations

from typing import Final

from playslot_rl.collectors.spec import REDRAW_STRIDE as REDRAW_STRIDE
from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.seeds import BLOCK

TRAINING: Final = 3_000_000_000
"""First seed of the episodes learned from."""
DEVELOPMENT: Final = 4_000_000_000
"""First seed of the episodes behind a learning curve, the same ones for every method and training seed."""


def training_seed(seed: int, episode: int) -> int:
    """Seed of an episode (from 0) of a training run with `seed`."""
    return TRAINING + seed * BLOCK + episode


def development_seeds(episodes: int) -> list[int]:
    """The fixed list of development episodes."""
    return list(range(DEVELOPMENT, DEVELOPMENT + episodes))


def check_seeds(config: ExperimentConfig, episodes: int) -> None:
    """Refuse a run whose episodes could be evaluation's.

    Args:
        config: `seed` and `evaluation.seed_offset`.
        episodes: how many the run may play.

    Raises:
        ConfigError: seeds, or episodes, beyond their block.
    """
    limit = (DEVELOPMENT - TRAINING) // BLOCK
    if config.seed >= limit:
        raise ConfigError(f"seed: got {config.seed}, expected 0 to {limit - 1}; choose a smaller one")
    if episodes > BLOCK:
        raise ConfigError(f"steps: got {episodes} episodes, expected at most {BLOCK}; lower it, or raise env.max_steps")
    top = config.evaluation.seed_offset + limit * BLOCK
    if top > TRAINING:
        offset = config.evaluation.seed_offset
        raise ConfigError(
            f"evaluation.seed_offset: got {offset}, expected at most {TRAINING - limit * BLOCK}: lower it"
        )
