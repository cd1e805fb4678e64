"""`playslot pipeline env=E preset=P out=RUN`: all stages from nothing, data included; finished ones are skipped."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import DataConfig, ExperimentConfig
from playslot_rl.envs import PROCEDURAL, check_task, has_parts
from playslot_rl.recipes import evaluate, inspect, objects, train_dynamics, train_policy, train_slots
from playslot_rl.runs.opening import run_to_write


def main(config: ExperimentConfig) -> None:
    """Collect, train the three stages, evaluate under both protocols, write the report.

    With `data.root` set nothing is collected but missing demonstrations (`data.demos`). Where nothing can be acted on
    (GridShapes) there are neither demonstrations nor a policy, and slots and latent actions are scored instead.
    """
    began = time.monotonic()
    behaves = config.env.name not in PROCEDURAL
    if behaves:
        check_task(config.env, expert=not config.data.demos)  # refused now, not after hours of training
    name = config.out or config.run or f"runs/{config.env.full_name}_{config.preset}"
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
    if behaves and has_parts(config.env):
        objects.score_slots_if_needed(config, run_to_write(config))
    evaluate.main_if_needed(replace(config, run=name, out=""))
    print(f"pipeline: {time.monotonic() - began:.0f} s, report {folder / 'report.html'}", flush=True)


def _collect(config: ExperimentConfig, folder: Path) -> DataConfig:
    """Record what is missing; returns where the data are."""
    from playslot_rl.collectors.collection import collect_demos, collect_videos

    config = replace(config, data=collect_demos(config, folder))
    return config.data if config.data.root else collect_videos(config, folder)
