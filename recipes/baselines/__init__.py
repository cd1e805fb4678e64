"""Recipes of the baselines, one module a method: `main(config)` trains it. `evaluate` is the same for all of them."""

from __future__ import annotations

import importlib
from pathlib import Path

from playslot_rl.config import ExperimentConfig


def evaluate(config: ExperimentConfig, run: Path) -> None:
    """Evaluate the baseline of `run` in simulation, write `RUN/evaluation/simulation/eval_info.json`, print the result.

    Raises:
        ConfigError: protocol `imagination`, or an environment other than the run's.
        CheckpointError: the run has no trained policy, or a damaged one.
    """
    from playslot_rl.acting.episodes import TaskPool
    from playslot_rl.config.methods import METHODS
    from playslot_rl.evaluation.success import check_baseline_protocol, evaluate_actor, run_facts
    from playslot_rl.recipes.evaluate import check_environment, describe
    from playslot_rl.recipes.run import open_device
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage
    from playslot_rl.training.runs import stage_env

    check_baseline_protocol(config)
    run_facts(run, config.method)  # a run without a policy is refused before anything is loaded
    env = stage_env(read_stage(checkpoint_folder(run, config.method), config.method))
    check_environment(config, env.image_size, env.action_dim)
    device = open_device(config)
    module, _, function = METHODS[config.method].actor.partition(":")
    actor = getattr(importlib.import_module(module), function)(run, device)
    actor.module.eval()
    with TaskPool(config.env, config.render) as pool:
        print(describe(evaluate_actor(run, actor, config, device, pool), run), flush=True)
