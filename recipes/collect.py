"""`playslot collect env=E policy=random|expert|noisy_expert episodes=N seed=S workers=W out=DIR`: record a data set."""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError


def main(config: ExperimentConfig) -> None:
    """Record `episodes` (or the preset's number) with the policy into `out`; the same command again carries on."""
    from playslot_rl.collectors import collect
    from playslot_rl.collectors.collection import playing

    if not config.out:
        raise ConfigError("out: got nothing, expected the folder of the data set, such as out=data/demos")
    want, policy = config.collect, "random" if config.policy == "random" else "expert"
    steps = want.random_steps if policy == "random" else want.expert_steps
    recorded = {"random": want.random_episodes, "expert": want.expert_episodes, "noisy_expert": want.noisy_episodes}
    episodes = config.episodes or recorded[config.policy]
    config = playing(config) if config.policy == "noisy_expert" else config
    root = collect(config, policy, episodes, steps, Path(config.out), config.seed, config.workers)
    print(f"data set: {root} ({episodes} episodes of {steps} agent steps)")
