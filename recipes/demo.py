"""`playslot demo`: the main job in minutes, on a pretrained world model. Writes everything under `runs/demo/`."""

from __future__ import annotations

import time
from dataclasses import replace

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError
from playslot_rl.recipes import evaluate, inspect, train_policy
from playslot_rl.runs import Run
from playslot_rl.runs.opening import run_to_write
from playslot_rl.seeds.episodes import LARGEST_SEED

FIRST_SEED = 7
"""Added to `seed`: the pretrained model was trained on videos of the base seeds 0 and 1, and the demo sees new ones."""


def main(config: ExperimentConfig) -> None:
    """Collect demonstrations, train policy and decoder, inspect the world model on them, evaluate under both protocols,
    write the report.
    """
    from playslot_rl.collectors.collection import collect_demos
    from playslot_rl.envs import check_task

    began = time.monotonic()
    check_task(
        config.env, expert=not config.data.demos
    )  # one without a simulator is refused before anything is written
    name = config.out or "runs/demo"
    if config.seed > LARGEST_SEED - FIRST_SEED:
        raise ConfigError(
            f"seed: got {config.seed}, expected at most {LARGEST_SEED - FIRST_SEED}; choose a smaller one"
        )
    config = replace(config, out=name, run="pretrained", seed=FIRST_SEED + config.seed)
    run = run_to_write(config)
    folder, _ = run.folder, Run.of(config).world_stages  # a missing one is refused before anything is recorded
    if not (folder / "config.json").is_file():
        run.store(config)
    config = replace(config, data=collect_demos(config, folder))
    train_policy.main(config)
    shown = replace(config.data, root=config.data.demos)
    inspect.main_if_needed(replace(config, run=name, out="", episodes=None, data=shown))
    evaluate.main_if_needed(replace(config, run=name, out=""))
    print(f"demo: {time.monotonic() - began:.0f} s")
    print(f"open {folder / 'report.html'}", flush=True)
