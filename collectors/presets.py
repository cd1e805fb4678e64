"""What a preset has recorded: demonstrations, and the videos a world model learns from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playslot_rl.collectors import collect
from playslot_rl.collectors.collection import begun_episodes
from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.envs import PROCEDURAL


def collect_demos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record demonstrations into `FOLDER/data/expert` unless `data.demos` names some; returns where the data are.

    Where nothing can be acted on there are none. `collect.validation_episodes` more than `collect.expert_episodes` are
    recorded and held out; a data set begun without them stays as it is.
    """
    if config.data.demos or config.env.name in PROCEDURAL:
        return config.data
    demos, want = folder / "data" / "expert", config.collect
    held_out = 0 if begun_episodes(demos) == want.expert_episodes else want.validation_episodes
    episodes = want.expert_episodes + held_out
    collect(config, "expert", episodes, want.expert_steps, demos, config.seed, config.workers)
    return replace(config.data, demos=str(demos), held_out=held_out)


def collect_videos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record the world model's videos below `FOLDER/data`; `data.demos` are among them where the preset wants it."""
    random, want = folder / "data" / "random", config.collect
    collect(config, "random", want.random_episodes, want.random_steps, random, config.seed, config.workers)
    if config.env.name in PROCEDURAL:
        return replace(config.data, root=str(random))
    roots = [str(random)]
    if want.noisy_episodes:
        # Random actions never reach the object. Videos of a noisy expert (no action is read from them) show the world
        # model the places a policy goes to; the paper has 9,000 random episodes instead.
        noisy = folder / "data" / "noisy_expert"
        noise = replace(config, collect=replace(want, noise=want.exploration_noise))
        # The next base seed: no episode of the demonstrations comes twice.
        collect(noise, "expert", want.noisy_episodes, want.expert_steps, noisy, config.seed + 1, config.workers)
        roots.append(str(noisy))
    if want.learn_from_demos and config.data.demos:
        roots.append(config.data.demos)
    return replace(config.data, root=",".join(roots))
