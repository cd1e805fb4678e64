"""`playslot train-baseline method=dreamer env=E out=DIR`: DreamerV3 from pixels, by acting in the task."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.recipes.baselines.online import online_record, train_and_save
from playslot_rl.recipes.run import open_device, open_run


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

    from playslot_rl.baselines.dreamer.learner import DreamerLearner
    from playslot_rl.baselines.dreamer.load import NAME
    from playslot_rl.baselines.dreamer.networks import DreamerNetworks
    from playslot_rl.seeding import global_seed

    record = online_record(config, own, run, NAME)
    if record.finished():
        return
    device = open_device(config)
    with global_seed(config.seed, 0, NAME):
        networks = DreamerNetworks(own, config.env).to(device)
        learner = DreamerLearner(networks, own)
    train_and_save(record, own, learner, {"networks": networks}, device)
