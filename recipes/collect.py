"""`playslot collect env=E policy=random|expert episodes=N seed=S workers=W out=DIR`: record a LeRobot data set."""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError


def main(config: ExperimentConfig) -> None:
    """Record `episodes` (or the preset's number) with the policy into `out`; the same command again carries on."""
    from playslot_rl.collectors import collect

    if not config.out:
        raise ConfigError("out: got nothing, expected the folder of the data set, such as out=data/demos")
    expert = config.policy == "expert"
    episodes = config.episodes or (config.collect.expert_episodes if expert else config.collect.random_episodes)
    steps = config.collect.expert_steps if expert else config.collect.random_steps
    root = collect(config, config.policy, episodes, steps, Path(config.out), config.seed, config.workers)
    print(f"data set: {root} ({episodes} episodes of {steps} agent steps)")
