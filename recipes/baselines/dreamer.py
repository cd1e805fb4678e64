"""`playslot train-baseline method=dreamer env=E out=DIR`: DreamerV3 from pixels, by acting in the task."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import finished, open_device, open_run, store_config


def main(config: ExperimentConfig) -> None:
    """Train DreamerV3 into `OUT/dreamer`; killed, the same command carries on; finished, it says so.

    Raises:
        ConfigError: an environment without a simulator or without a dense reward, or sizes that do not fit.
        CheckpointError: `out` was begun otherwise.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.baselines.online.requirements import require_online

    own = config.baselines.dreamer
    require_online(config, own, "dreamer")  # before anything is written or computed
    run = open_run(config)

    import torch

    from playslot_rl.baselines.dreamer.learner import DreamerLearner
    from playslot_rl.baselines.dreamer.load import NAME
    from playslot_rl.baselines.dreamer.networks import DreamerNetworks
    from playslot_rl.baselines.methods import METHODS
    from playslot_rl.baselines.online.loop import fixed_keys, train_online
    from playslot_rl.training.checkpoints import checkpoint_folder, save_stage
    from playslot_rl.training.seeding import derived_seed

    trained_as = {"env": to_dict(config.env), NAME: fixed_keys(own)}
    if finished(config, run, NAME, trained_as, {}, ""):
        return
    device = open_device(config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, NAME))
        networks = DreamerNetworks(own, config.env).to(device)
        learner = DreamerLearner(networks, own)
    title = METHODS[NAME].title
    result = train_online(
        learner,
        own,
        config,
        run / NAME,
        name=NAME,
        title=title,
        device=device,
        ready=lambda: store_config(config, run),
    )
    state = result.state
    save_stage(
        checkpoint_folder(run, NAME),
        stage=NAME,
        modules={"networks": networks},
        config={"env": to_dict(config.env), NAME: to_dict(own)},
        data={},
        parents={},
        metrics=state.metrics,
        steps=state.updates,
        seconds=state.seconds,
        extra={
            "seed": config.seed,
            "env_steps": state.step,
            "random_policy": result.random,
            "parameters": sum(parameter.numel() for parameter in networks.parameters()),
        },
    )
    random, last = result.random, state.curve[-1]
    print(
        f"{NAME}: {state.step} agent steps, {state.updates} updates; development episodes: return "
        f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}), success {100 * last['success_rate']:.0f} % "
        f"(random {100 * random['success_rate']:.0f} %); {run / NAME}",
        flush=True,
    )
