"""`playslot demo`: the main job in minutes, on the shipped world model. Writes everything under `runs/demo/`."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes import evaluate, train_policy
from playslot_rl.recipes.run import open_run

SEED = 7
"""Base seed of the demo's demonstrations where none is given: not one the shipped model was trained on."""


def main(config: ExperimentConfig) -> None:
    """Collect demonstrations, train policy and decoder, evaluate under both protocols, write the report."""
    from playslot_rl.collectors import collect

    began = time.monotonic()
    name = config.out or "runs/demo"
    config = replace(config, out=name, run="pretrained", seed=config.seed or SEED)
    folder = open_run(config)
    demos = Path(config.data.demos or folder / "data" / "expert")
    if not config.data.demos:
        want = config.collect
        collect(config, "expert", want.expert_episodes, want.expert_steps, demos, config.seed, config.workers)
    config = replace(config, data=replace(config.data, demos=str(demos)))
    train_policy.main(config)
    for protocol in ("simulation", "imagination"):
        chosen = replace(config, run=name, out="", protocol=protocol)
        evaluate.main(chosen, report=protocol == "imagination")
    print(f"demo: {time.monotonic() - began:.0f} s")
    print(f"open {folder / 'report.html'}", flush=True)
