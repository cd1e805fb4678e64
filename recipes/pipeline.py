"""`playslot pipeline env=E preset=P out=RUN`: all stages from nothing, data included; finished ones are skipped."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.envs import PROCEDURAL, gym_id
from playslot_rl.recipes import evaluate, inspect, slots, train_dynamics, train_policy, train_slots
from playslot_rl.runs.opening import run_to_write


def main(config: ExperimentConfig) -> None:
    """Collect, train the three stages, evaluate under both protocols, write the report.

    With `data.root` set nothing is collected but missing demonstrations (`data.demos`). Where nothing can be acted on
    (GridShapes) there are neither demonstrations nor a policy, and slots and latent actions are scored instead.
    """
    began = time.monotonic()
    behaves = config.env.name not in PROCEDURAL
    if behaves:
        gym_id(config.env.name)  # refused now, not after hours of training
    name = config.out or config.run or f"runs/{config.env.name}_{config.preset}"
    config = replace(config, out=name, run="")
    run = run_to_write(config)
    folder = run.folder
    if not (folder / "config.json").is_file():  # a stage stores it anew once it finds that it fits
        run.store(config)
    config = replace(config, data=_collect(config, folder))
    for stage in (train_slots, train_dynamics, *([train_policy] if behaves else [])):
        since = time.monotonic()
        stage.main(config)
        print(f"{stage.__name__.rsplit('.', 1)[-1]}: {time.monotonic() - since:.0f} s", flush=True)
    inspect.main_if_needed(replace(config, run=name, out="", episodes=None))
    if behaves:
        slots.main_if_needed(config, run_to_write(config))
    evaluate.main_if_needed(replace(config, run=name, out=""))
    print(f"pipeline: {time.monotonic() - began:.0f} s, report {folder / 'report.html'}", flush=True)


def _collect(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record what is missing; returns where the data are."""
    config = replace(config, data=collect_demos(config, folder))
    return config.data if config.data.root else collect_videos(config, folder)


def collect_demos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record demonstrations into `FOLDER/data/expert` unless `data.demos` names some; returns where the data are.

    Where nothing can be acted on there are none. `collect.validation_episodes` more than `collect.expert_episodes` are
    recorded and held out; a data set begun without them stays as it is.
    """
    from playslot_rl.collectors import collect
    from playslot_rl.collectors.collection import begun_episodes

    if config.data.demos or config.env.name in PROCEDURAL:
        return config.data
    demos, want = folder / "data" / "expert", config.collect
    held_out = 0 if begun_episodes(demos) == want.expert_episodes else want.validation_episodes
    episodes = want.expert_episodes + held_out
    collect(config, "expert", episodes, want.expert_steps, demos, config.seed, config.workers)
    return replace(config.data, demos=str(demos), held_out=held_out)


def collect_videos(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record the world model's videos below `FOLDER/data`; `data.demos` are among them where the preset wants it."""
    from playslot_rl.collectors import collect

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
