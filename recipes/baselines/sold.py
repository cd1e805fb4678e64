"""`playslot train-baseline method=sold run=WORLD out=DIR`: SOLD on the slots of a finished SAVi, by acting.

`run=pretrained` builds on the shipped world model; only its SAVi is used.
"""

from __future__ import annotations

from pathlib import Path

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import finished, open_device, open_run, parent_run, store_config


def main(config: ExperimentConfig) -> None:
    """Train SOLD into `OUT/sold`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        ConfigError: settings that do not fit each other.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.baselines.online.loop import FREE_KEYS, train_online
    from playslot_rl.baselines.online.seeds import check_seeds
    from playslot_rl.baselines.sold.learner import SOLDLearner
    from playslot_rl.baselines.sold.load import NAME, build_networks, prior_steps, slots_checkpoint
    from playslot_rl.training.checkpoints import (
        checkpoint_folder,
        link_world_model,
        load_savi,
        require_adoptable,
        require_config,
        run_folder,
        save_stage,
        world_model_folder,
    )
    from playslot_rl.training.seeding import derived_seed

    run, own = open_run(config), config.baselines.sold
    parent = parent_run(config, run)
    run_folder(parent, config.env.name)
    slots = slots_checkpoint(parent)
    require_adoptable(slots, run)
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    fixed = {key: value for key, value in to_dict(own).items() if key not in FREE_KEYS}
    if finished(config, run, NAME, {"env": to_dict(config.env), NAME: fixed}, {"slots": slots}, ""):
        return
    check_seeds(config, own.steps // config.env.max_steps + own.envs)
    before = prior_steps(own, slots)

    def ready() -> None:
        home = world_model_folder(parent)
        if home.resolve() != run.resolve():
            link_world_model(run, parent if parent == "pretrained" else Path(home))
        store_config(config, run)

    device = open_device(config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, NAME))
        networks = build_networks(own, slots, config.env.action_dim, config.env.max_steps).to(device)
    learner = SOLDLearner(load_savi(parent, device), networks, own, config.env.action_dim)
    result = train_online(
        learner,
        own,
        config,
        run / NAME,
        name=NAME,
        title="SOLD",
        device=device,
        identity={"slots": slots.fingerprint},
        ready=ready,
        prior_steps=before,
    )
    state = result.state
    save_stage(
        checkpoint_folder(run, NAME),
        stage=NAME,
        modules=networks.parts,
        config={"env": to_dict(config.env), NAME: to_dict(own)},
        data={},
        parents={"slots": slots.fingerprint},
        metrics=state.metrics,
        steps=state.updates,
        seconds=state.seconds,
        extra={
            "env_steps": state.step + before,
            "savi_steps": before,
            "episodes": state.episodes,
            "seed": config.seed,
            "random": result.random,
        },
    )
    reached = state.metrics.get("return_mean", float("nan"))
    print(
        f"{NAME}: return {reached:.1f} (random {result.random['return_mean']:.1f}) after {state.step} agent steps, "
        f"{run / NAME}",
        flush=True,
    )
