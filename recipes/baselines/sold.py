"""`playslot train-baseline method=sold run=WORLD out=DIR`: SOLD on the slots of a finished SAVi, by acting.

`run=pretrained` builds on the shipped world model; only its SAVi is used.
"""

from __future__ import annotations

from playslot_rl.compose import shipped
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import finished, open_device, open_run, parent_run, store_config


def main(config: ExperimentConfig) -> None:
    """Train SOLD into `OUT/sold`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        ConfigError: an environment without a simulator or a dense reward, or settings that do not fit.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.online.requirements import require_online

    own = config.baselines.sold
    require_online(config, own, "sold")  # before anything is written or computed
    run = open_run(config)

    import torch

    from playslot_rl.baselines.methods import METHODS
    from playslot_rl.baselines.online.loop import fixed_keys, train_online
    from playslot_rl.baselines.sold.learner import SOLDLearner
    from playslot_rl.baselines.sold.load import NAME, build_networks, prior_steps, slots_checkpoint
    from playslot_rl.training.checkpoints import checkpoint_folder, require_config, save_stage
    from playslot_rl.training.runs import link_world_model, load_savi, require_adoptable, world_model_folder
    from playslot_rl.training.seeding import derived_seed

    parent = parent_run(config, run)
    slots = slots_checkpoint(parent)
    require_adoptable(slots, run)
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    trained_as = {"env": to_dict(config.env), NAME: fixed_keys(own)}
    if finished(config, run, NAME, trained_as, {"slots": slots}, ""):
        return
    before = prior_steps(own, slots)

    def ready() -> None:
        home = world_model_folder(parent)
        if home.resolve() != run.resolve():
            link_world_model(run, parent if shipped(parent) else home)
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
        title=METHODS[NAME].title,
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
            "random_policy": result.random,
            "parameters": sum(parameter.numel() for parameter in networks.parameters()),
        },
    )
    random, last = result.random, state.curve[-1]
    print(
        f"{NAME}: {state.step} agent steps and {before} of SAVi's data, {state.updates} updates; development episodes: "
        f"return {last['return_mean']:.2f} (random {random['return_mean']:.2f}), success "
        f"{100 * last['success_rate']:.0f} % (random {100 * random['success_rate']:.0f} %); {run / NAME}",
        flush=True,
    )
